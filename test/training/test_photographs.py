"""Photographs as shards: the crops that the estimator would cut, with the jitter of training."""

import numpy as np
import pytest

from relpose_ros.captures.folder import Frame, save_capture
from relpose_ros.captures.shards import PLAN, Shard, ShardError, new_shard
from relpose_ros.geometry import so3
from relpose_ros.training.batches import FIELDS, Scans, open_scans
from relpose_ros.training.photographs import (
    CaptureShardError,
    capture_shard,
    write_capture_shards,
)
from relpose_ros.views import BoundingBox, View


@pytest.fixture
def capture(tmp_path):
    generator = np.random.default_rng(0)
    frames = []
    for k, rotation in enumerate(so3.random_rotations(3, generator)):
        image = np.full((48, 64, 3), 100, np.uint8)
        mask = np.zeros((48, 64), bool)
        image[10:30, 20:40], mask[10:30, 20:40] = 200, True
        pose = None if k == 1 else np.column_stack([rotation, [0, 0, 3]])
        frames.append(Frame(View(image, BoundingBox(20, 10, 40, 30), 64, 48, mask=mask), pose))
    return save_capture(tmp_path / "capture", frames)


def test_crops_show_the_box_with_jitter_and_poses_stay(capture, tiny_preset, tmp_path):
    shard = capture_shard(capture, tiny_preset, 4, masked_copies=1, seed=1)
    assert shard["images"].shape == (4, 2, 32, 32, 3)
    np.testing.assert_allclose(shard["camera_from_object"][2, 1], capture.photos[2].camera_from_world)
    np.testing.assert_array_equal(shard["image_sizes"][0], [[64, 48]] * 2)
    assert (np.abs(shard["images"][:, :, 16, 16].astype(int) - 200) <= 3).all()
    border = shard["images"][:, :, 0, 0].astype(int)
    assert (np.abs(border[0] - 255) <= 3).all()  # masked: white
    assert (np.abs(border[1:] - 100) <= 6).all()
    sides = shard["crop_parameters"][..., 2] * 24
    assert sides.min() >= 21.5
    assert sides.max() <= 24.5
    assert len(np.unique(shard["crop_parameters"][:, 0, :2], axis=0)) > 1
    again = capture_shard(capture, tiny_preset, 4, masked_copies=1, seed=1)
    np.testing.assert_array_equal(again["images"], shard["images"])
    with new_shard(tmp_path / "shards" / "00000", {}) as arrays:
        arrays |= shard
    scans = Scans([Shard(tmp_path / "shards" / "00000")])
    assert len(scans) == 4
    assert set(scans.row(3)) == {"images", *FIELDS}


def test_a_capture_without_poses_is_refused(capture, tiny_preset, tmp_path):
    frame = Frame(capture.view(1), None)
    lone = save_capture(tmp_path / "lone", [frame, frame])
    with pytest.raises(CaptureShardError, match="0 photos"):
        capture_shard(lone, tiny_preset, 2)


def test_shards_of_many_captures_go_on_where_they_were_cut_off(capture, tiny_preset, tmp_path):
    folder = tmp_path / "shards"
    other = save_capture(tmp_path / "other", [Frame(capture.view(k), np.eye(3, 4)) for k in (0, 2)])
    (folder / "other.unfinished").mkdir(parents=True)
    assert write_capture_shards(folder, [capture], tiny_preset, 2, seed=1) == 1
    first = Shard(folder / "capture")
    images = np.array(first["images"])
    assert write_capture_shards(folder, [capture, other], tiny_preset, 2, seed=1) == 2
    assert {path.name for path in folder.iterdir()} == {"capture", "other"}
    assert len(open_scans([folder])) == 4
    np.testing.assert_array_equal(first["images"], images)
    for asked, copies, seed in (("copies 2, not 3", 3, 1), ("seed 1, not 2", 2, 2)):
        with pytest.raises(ShardError, match=f"capture was made with {asked}: name another folder"):
            write_capture_shards(folder, [capture], tiny_preset, copies, seed=seed)
    (folder / "capture" / PLAN).unlink()
    with pytest.raises(ShardError, match="capture does not say how it was made"):
        write_capture_shards(folder, [capture], tiny_preset, 2, seed=1)


def test_shards_that_cannot_be_made(capture, tiny_preset, tmp_path):
    for copies, masked in ((0, 0), (2, 3), (1, -1)):
        with pytest.raises(CaptureShardError, match="cannot be made"):
            write_capture_shards(tmp_path / "a", [capture], tiny_preset, copies, masked_copies=masked)
    with pytest.raises(CaptureShardError, match="two captures are called capture"):
        write_capture_shards(tmp_path / "b", [capture, capture], tiny_preset, 1)
    (tmp_path / "file").touch()
    with pytest.raises(ShardError, match=r"file/capture cannot be written: Not a directory"):
        write_capture_shards(tmp_path / "file", [capture], tiny_preset, 1)
