from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from relpose_ros.captures.folder import CaptureError, Frame, load_capture, save_capture
from relpose_ros.views import BoundingBox, Intrinsics, View

SHARED = Path(__file__).resolve().parents[3] / "shared"

POSE = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, -0.25], [0, 0, 1, 2]])


def smooth_image(width: int, height: int) -> np.ndarray:
    """A gradient in each channel: JPEG keeps it to within a few levels, and the channels differ."""
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return np.stack([x, y, 255 - x], axis=-1).astype(np.uint8)


def frame(*, posed: bool = True, masked: bool = True) -> Frame:
    mask = np.zeros((48, 64), dtype=bool)
    mask[10:30, 20:40] = True
    return Frame(
        view=View(
            image=smooth_image(64, 48),
            box=BoundingBox(20, 10, 40.25, 30),
            full_width=64,
            full_height=48,
            intrinsics=Intrinsics(50, 51, 32, 24) if posed else None,
            mask=mask if masked else None,
        ),
        camera_from_world=POSE if posed else None,
        complete=False,
        source="IMG_1.JPG",
    )


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    written = frame()
    capture = save_capture(tmp_path / "mug", iter([written, frame(posed=False, masked=False)]))
    assert capture.name == "mug"
    posed, bare = capture.photos
    assert posed.intrinsics == Intrinsics(50, 51, 32, 24)
    assert posed.camera_from_world is not None
    np.testing.assert_allclose(posed.camera_from_world, POSE, atol=1e-9)
    assert (posed.complete, posed.source) == (False, "IMG_1.JPG")
    assert (bare.intrinsics, bare.camera_from_world, bare.mask) == (None, None, None)

    view = capture.view(0)
    assert (view.full_width, view.full_height, view.origin) == (64, 48, (0, 0))
    assert view.box == written.view.box
    assert np.abs(view.image.astype(int) - written.view.image.astype(int)).mean() < 3
    assert view.mask is not None
    assert written.view.mask is not None
    assert (view.mask == written.view.mask).all()
    assert capture.view(0, masked=False).mask is None


def test_a_mask_with_soft_edges_is_cut_in_the_middle(tmp_path: Path) -> None:
    capture = save_capture(tmp_path, [frame()])
    grey = np.tile(np.arange(64, dtype=np.uint8) * 4, (48, 1))
    assert cv2.imwrite(str(tmp_path / "masks/000.png"), grey)
    mask = capture.view(0).mask
    assert mask is not None
    np.testing.assert_array_equal(mask, np.tile(np.arange(64) >= 32, (48, 1)))


def test_an_orientation_tag_does_not_turn_a_photo(tmp_path: Path) -> None:
    """The listing counts the pixels as they are stored."""
    capture = save_capture(tmp_path, [frame()])
    plain = capture.view(0).image
    file = tmp_path / "images/000.jpg"
    data = file.read_bytes()
    exif = b"Exif\0\0II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
    file.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:])
    assert cv2.imread(str(file)).shape == (64, 48, 3), "OpenCV by itself follows the tag"
    np.testing.assert_array_equal(capture.view(0).image, plain)


def test_a_folder_is_not_written_over(tmp_path: Path) -> None:
    save_capture(tmp_path, [frame()])
    with pytest.raises(CaptureError, match="holds a capture already"):
        save_capture(tmp_path, [frame()])


def test_a_crop_is_no_frame(tmp_path: Path) -> None:
    view = View(smooth_image(10, 10), BoundingBox(1, 1, 5, 5), full_width=64, full_height=48, origin=(3, 3))
    with pytest.raises(CaptureError, match="not the whole image"):
        save_capture(tmp_path, [Frame(view)])


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"box": [0, 0, 65, 48]}, "not inside the image of 64 x 48"),
        ({"box": [-1, 0, 64, 48]}, "not inside the image of 64 x 48"),
        ({"box": [0, -1, 64, 48]}, "not inside the image of 64 x 48"),
        ({"box": [0, 0, 64, 49]}, "not inside the image of 64 x 48"),
        ({"box": [5, 5, 5, 9]}, "is empty"),
        ({"box": [5, 5, 9]}, "4 finite numbers"),
        ({"box": ["a", 5, 9, 9]}, "4 finite numbers"),
        ({"width": 0}, "whole and positive"),
        ({"height": 4.5}, "whole and positive"),
        ({"width": "64"}, "a finite number is needed"),
        ({"fx": float("nan")}, "a finite number is needed"),
        ({"fx": -1}, "must be positive"),
        ({"fy": 0}, "must be positive"),
        ({"cy": None}, "not all of fx, fy, cx, cy"),
        ({"file": "images/009.jpg"}, "not in the folder"),
        ({"file": "../../etc/passwd"}, "outside the capture's folder"),
        ({"camera_from_world": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "3 x 4 finite numbers"),
        ({"camera_from_world": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "no rotation"),
        ({"camera_from_world": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "no rotation"),
    ],
)
def test_an_entry_that_makes_no_sense_is_named(
    tmp_path: Path, change: dict[str, object], sentence: str
) -> None:
    save_capture(tmp_path, [frame(), frame()])
    listing = tmp_path / "cameras.json"
    content = json.loads(listing.read_text())
    content["images"][1].update(change)
    listing.write_text(json.dumps(content))
    with pytest.raises(CaptureError, match=sentence) as refusal:
        load_capture(tmp_path)
    assert "image 1 of" in str(refusal.value)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "cannot be read as JSON"),
        ("[]", "no list called 'images'"),
        ('{"images": []}', "lists no images"),
        ('{"images": [3]}', "not an object"),
        ('{"images": [{"file": "x.jpg"}]}', "has no 'width'"),
        ('{"convention": "OpenGL", "images": [1]}', "convention 'OpenGL'"),
    ],
)
def test_a_listing_that_makes_no_sense_is_refused(tmp_path: Path, content: str, sentence: str) -> None:
    (tmp_path / "cameras.json").write_text(content)
    with pytest.raises(CaptureError, match=sentence):
        load_capture(tmp_path)


def test_a_missing_folder_and_a_missing_listing_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="does not exist"):
        load_capture(tmp_path / "nowhere")
    with pytest.raises(CaptureError, match=r"no cameras\.json"):
        load_capture(tmp_path)


def test_pixels_must_be_those_that_the_listing_describes(tmp_path: Path) -> None:
    capture = save_capture(tmp_path, [frame(), frame()])
    (tmp_path / "images/000.jpg").write_bytes((tmp_path / "images/001.jpg").read_bytes()[:100])
    with pytest.raises(CaptureError, match="no readable image"):
        capture.view(0)
    listing = tmp_path / "cameras.json"
    listing.write_text(listing.read_text().replace('"width": 64', '"width": 80'))
    with pytest.raises(CaptureError, match="is 64 x 48 pixels"):
        load_capture(tmp_path).view(1)


@pytest.mark.skipif(not (SHARED / "captures").is_dir(), reason="the shared captures are not here")
@pytest.mark.parametrize("name", ["dev/saharov32", "dev/maryrose_tankard", "unposed/robot"])
def test_real_captures_load(name: str) -> None:
    capture = load_capture(SHARED / "captures" / name)
    view = capture.view(len(capture.photos) - 1)
    assert view.image.shape == (view.full_height, view.full_width, 3)
    assert (view.intrinsics is None) == name.startswith("unposed")
    assert (view.mask is None) == (name == "dev/saharov32")
