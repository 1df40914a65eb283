from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from relpose_ros.captures.folder import CaptureError, Photo, load_capture
from relpose_ros.geometry import so3
from relpose_ros.replay.bags import BagError, BagReader
from relpose_ros.replay.pack import pack

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from typing import Any

    from relpose_ros.replay.comparison import TruePose


def read(path: Path) -> dict[str, list[Any]]:
    messages: dict[str, list[Any]] = {}
    with BagReader(path) as bag:
        for record in bag.records(bag.topics):
            assert record.log_time_ns == record.message.header.stamp.sec * 10**9
            messages.setdefault(record.topic, []).append(record.message)
    return messages


def test_photos_go_in_as_they_are(tmp_path: Path, capture: tuple[Path, list[TruePose]]) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "bag")
    messages = read(tmp_path / "bag")
    assert {topic: len(each) for topic, each in messages.items()} == {
        "/image/compressed": 5,
        "/camera_info": 5,
        "/ground_truth/pose": 5,
    }
    assert [each.header.stamp.sec for each in messages["/image/compressed"]] == [1, 2, 3, 4, 5]
    picture, info = messages["/image/compressed"][2], messages["/camera_info"][2]
    assert picture.data.tobytes() == (folder / "images/002.jpg").read_bytes()
    assert (picture.format, picture.header.frame_id) == ("jpeg", info.header.frame_id)
    assert (info.width, info.height) == (64, 48)
    assert (info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height) == (14, 10, 28, 28)
    # ROS counts pixels from the centre of the first one, a capture from its corner.
    assert info.k.tolist() == [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]
    pose = messages["/ground_truth/pose"][3].pose
    p, q = pose.position, pose.orientation
    np.testing.assert_allclose([p.x, p.y, p.z], truth[3].centre, atol=1e-6)
    rotation = so3.from_quaternion_xyzw([q.x, q.y, q.z, q.w])
    np.testing.assert_allclose(rotation, truth[3].world_from_camera, atol=1e-6)


def test_object_views_carry_mask_and_id(tmp_path: Path, capture: tuple[Path, list[TruePose]]) -> None:
    folder, _ = capture
    pack(folder, tmp_path / "bag", form="object_view", views=[4, 0], period_s=2.0)
    views = read(tmp_path / "bag")["/object_view"]
    assert [view.header.stamp.sec for view in views] == [1, 3]
    view = views[0]
    assert view.object_id == "cup"
    assert view.compressed.data.tobytes() == (folder / "images/004.jpg").read_bytes()
    mask = view.mask.data.reshape(view.mask.height, view.mask.step)
    assert (mask > 0).sum() == 24 * 24
    assert (view.full_width, view.full_height, len(view.image.data)) == (64, 48, 0)
    assert view.k[2] == 31.5


def test_a_capture_without_poses_gives_boxes_alone(
    tmp_path: Path, write_posed_capture: Callable[..., Any]
) -> None:
    write_posed_capture(tmp_path / "cup", 2, posed=False)
    pack(tmp_path / "cup", tmp_path / "bag")
    messages = read(tmp_path / "bag")
    assert set(messages) == {"/image/compressed", "/camera_info"}
    assert not messages["/camera_info"][0].k.any()
    assert messages["/camera_info"][0].roi.width == 28


def test_the_same_photos_give_the_same_bytes(tmp_path: Path, capture: tuple[Path, Any]) -> None:
    for name in ("one", "two"):
        pack(capture[0], tmp_path / name / "bag")
    for file in ("bag.mcap", "metadata.yaml"):
        assert (tmp_path / "one/bag" / file).read_bytes() == (tmp_path / "two/bag" / file).read_bytes()


def test_a_photo_is_labelled_by_what_it_is(tmp_path: Path, capture: tuple[Path, Any]) -> None:
    folder, _ = capture
    photo = folder / "images/001.jpg"
    photo.write_bytes(cv2.imencode(".png", cv2.imread(str(photo)))[1].tobytes())
    pack(folder, tmp_path / "bag")
    assert [each.format for each in read(tmp_path / "bag")["/image/compressed"][:3]] == [
        "jpeg",
        "png",
        "jpeg",
    ]


@pytest.mark.parametrize("form", ["image", "object_view"])
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda picture: cv2.imencode(".webp", picture)[1].tobytes(), "neither a JPEG nor a PNG"),
        (lambda _: b"", "neither a JPEG nor a PNG"),
        (lambda picture: cv2.imencode(".jpg", picture)[1].tobytes()[:-9], "is damaged: .* are cut off"),
        (lambda picture: cv2.imencode(".jpg", picture[::2])[1].tobytes(), "64 x 24 pixels, .* says 64 x 48"),
    ],
)
def test_a_photo_that_nobody_could_use_leaves_no_half_bag(
    tmp_path: Path, capture: tuple[Path, Any], form: Any, spoil: Callable[[Any], bytes], said: str
) -> None:
    folder, _ = capture
    photo = folder / "images/003.jpg"
    photo.write_bytes(spoil(cv2.imread(str(photo))))
    with pytest.raises(BagError, match=f"003.jpg .*{said}"):
        pack(folder, tmp_path / "deep/bag", form=form)
    assert not (tmp_path / "deep/bag").exists()


def test_an_interrupted_pack_leaves_no_half_bag(
    tmp_path: Path, capture: tuple[Path, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Photo, "read_mask", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pack(capture[0], tmp_path / "bag", form="object_view")
    assert not (tmp_path / "bag").exists()


def test_what_cannot_be_packed_is_told(tmp_path: Path, capture: tuple[Path, Any]) -> None:
    folder, _ = capture
    with pytest.raises(BagError, match=r"photos 0 to 4; there is no photo 5"):
        pack(folder, tmp_path / "bag", views=[0, 5])
    with pytest.raises(BagError, match="No photo"):
        pack(folder, tmp_path / "bag", views=[])
    for period in (0, -1, 1e-10, 2e9, math.inf, math.nan):
        with pytest.raises(BagError, match="a nanosecond or more"):
            pack(folder, tmp_path / "bag", period_s=period)
    with pytest.raises(CaptureError):
        pack(tmp_path / "nowhere", tmp_path / "bag")
    assert not (tmp_path / "bag").exists()
    with pytest.raises(BagError, match="exists already"):
        pack(folder, folder)
    assert len(load_capture(folder).photos) == 5
