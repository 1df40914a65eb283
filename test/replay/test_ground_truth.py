"""Bags to measure on: every view whose true pose is known, as the node would see it."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from relpose_ros.geometry.cameras import camera_centre
from relpose_ros.replay.bags import BagError, is_bag
from relpose_ros.replay.ground_truth import read_posed_views
from relpose_ros.replay.pack import pack

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from relpose_ros.replay.bags import Record
    from relpose_ros.replay.comparison import TruePose

    Capture = tuple[Path, list[TruePose]]
    Rewrite = Callable[[Path, Path, Callable[[Record], Iterable[Record]]], Path]

TRUTH = "/ground_truth/pose"


@pytest.mark.parametrize(("form", "object_id"), [("image", "object"), ("object_view", "cup")])
def test_every_photo_of_a_capture_is_a_view_with_its_pose(
    tmp_path: Path, capture: Capture, form: Any, object_id: str
) -> None:
    folder, poses = capture
    pack(folder, tmp_path / "bag", form=form)
    objects = read_posed_views(tmp_path / "bag")
    assert list(objects) == [object_id]
    assert len(objects[object_id]) == len(poses)
    for k, (found, pose) in enumerate(zip(objects[object_id], poses, strict=True)):
        assert found.view.stamp_ns == (k + 1) * 10**9
        assert abs(int(found.view.image[..., 0].mean()) - (20 * k + 20)) <= 3
        assert (found.view.box.x0, found.view.box.y1) == (14, 38)
        assert (found.view.mask is not None) == (form == "object_view")
        rotation, translation = found.camera_from_world[:, :3], found.camera_from_world[:, 3]
        np.testing.assert_allclose(rotation, pose.world_from_camera.T, atol=1e-6)
        np.testing.assert_allclose(camera_centre(rotation, translation), pose.centre, atol=1e-6)


def test_views_without_a_pose_and_messages_that_are_no_view_are_left_out(
    tmp_path: Path, capture: Capture, rewrite: Rewrite, caplog: pytest.LogCaptureFixture
) -> None:
    pack(capture[0], tmp_path / "whole", form="object_view")

    def change(record: Record) -> list[Record]:
        stamp = record.message.header.stamp.sec
        if record.topic == TRUTH:
            return [] if stamp == 2 else [record]
        if stamp == 4:
            record.message.box.width = 3
        return [record, record] if stamp == 5 else [record]

    bag = rewrite(tmp_path / "whole", tmp_path / "bag", change)
    (views,) = read_posed_views(bag).values()
    assert [each.view.stamp_ns // 10**9 for each in views] == [1, 3, 5]
    assert "too small" in caplog.text


def test_a_pose_is_that_of_one_camera(tmp_path: Path, capture: Capture, rewrite: Rewrite) -> None:
    """Two cameras that are triggered together: nothing says whose pose it is."""
    pack(capture[0], tmp_path / "one", form="object_view")

    def double(record: Record) -> list[Record]:
        if record.topic == TRUTH or record.message.header.stamp.sec != 3:
            return [record]
        other = copy.deepcopy(record)
        other.message.header.frame_id = "another_camera"
        return [record, other]

    (views,) = read_posed_views(rewrite(tmp_path / "one", tmp_path / "two", double)).values()
    assert [each.view.stamp_ns // 10**9 for each in views] == [1, 2, 4, 5]


def test_each_object_has_its_views(tmp_path: Path, capture: Capture, rewrite: Rewrite) -> None:
    pack(capture[0], tmp_path / "one", form="object_view")

    def rename(record: Record) -> list[Record]:
        if record.topic != TRUTH and record.message.header.stamp.sec > 3:
            record.message.object_id = "mug"
        return [record]

    objects = read_posed_views(rewrite(tmp_path / "one", tmp_path / "two", rename))
    assert {name: len(views) for name, views in objects.items()} == {"cup": 3, "mug": 2}


def test_a_bag_without_truth_is_refused_in_a_sentence(
    tmp_path: Path, capture: Capture, write_posed_capture: Callable[..., Any], rewrite: Rewrite
) -> None:
    write_posed_capture(tmp_path / "plain", 3, posed=False)
    pack(tmp_path / "plain", tmp_path / "bag")
    with pytest.raises(
        BagError, match="holds no true poses: record them as PoseStamped on ground_truth/pose"
    ):
        read_posed_views(tmp_path / "bag")
    pack(capture[0], tmp_path / "posed")

    def late(record: Record) -> list[Record]:
        record.message.header.stamp.nanosec += record.topic == TRUTH
        return [record]

    with pytest.raises(BagError, match="5 true poses, but none with the stamp of a view"):
        read_posed_views(rewrite(tmp_path / "posed", tmp_path / "late", late))


def test_a_bag_is_told_from_a_capture(tmp_path: Path, capture: Capture) -> None:
    pack(capture[0], tmp_path / "bag")
    assert is_bag(tmp_path / "bag")
    assert is_bag(tmp_path / "bag/bag.mcap")
    (tmp_path / "bag/metadata.yaml").unlink()
    assert is_bag(tmp_path / "bag")
    assert not is_bag(capture[0])
    assert not is_bag(tmp_path / "missing")
