"""CO3Dv2 as captures, on a tiny folder in its format."""

import gzip
import json

import cv2
import numpy as np
import pytest

from relpose_ros.captures import co3d
from relpose_ros.captures.folder import CaptureError
from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import project_points

WIDTH, HEIGHT = 60, 40
# In PyTorch3D's camera axes (x left, y up, z forward) and row vectors: x_cam = x_world R + T.
R, T = so3.exp([0.1, -0.4, 0.2]), np.array([0.05, -0.1, 4.0])
FOCAL, CENTRE = np.array([3.0, 3.0]), np.array([0.1, -0.2])


@pytest.fixture
def dataset(tmp_path):
    def write(frames=3, kind="ndc_isotropic", empty=(), missing=(), scores=(1.0, 0.2)):
        folder = tmp_path / "cup"
        annotations = []
        for sequence in ("b_sequence", "a_sequence"):
            (folder / sequence / "images").mkdir(parents=True)
            (folder / sequence / "masks").mkdir()
            for k in reversed(range(frames)):
                image, mask = f"cup/{sequence}/images/{k}.jpg", f"cup/{sequence}/masks/{k}.png"
                cv2.imwrite(str(tmp_path / image), np.full((HEIGHT, WIDTH, 3), 10 * k, np.uint8))
                pixels = np.zeros((HEIGHT, WIDTH), np.uint8)
                if k not in empty:
                    pixels[10:30, 20:50] = 255
                cv2.imwrite(str(tmp_path / mask), pixels)
                viewpoint = {
                    "R": R.tolist(),
                    "T": T.tolist(),
                    "focal_length": FOCAL.tolist(),
                    "principal_point": CENTRE.tolist(),
                    "intrinsics_format": kind,
                }
                annotations.append(
                    {
                        "sequence_name": sequence,
                        "frame_number": k,
                        "image": {"path": image, "size": [HEIGHT, WIDTH]},
                        "mask": {"path": mask, "mass": 600.0},
                        "viewpoint": None if k in missing else viewpoint,
                    }
                )
        sequences = [
            {"sequence_name": name, "category": "cup", "viewpoint_quality_score": score}
            for name, score in zip(("a_sequence", "b_sequence"), scores, strict=True)
        ]
        for name, content in (("frame", annotations), ("sequence", sequences)):
            with gzip.open(folder / f"{name}_annotations.jgz", "wt") as stream:
                json.dump(content, stream)
        return tmp_path

    return write


def test_sequences_come_in_order_with_frames_in_order(dataset):
    captures = list(co3d.load_category(dataset(), "cup"))
    assert [capture.name for capture in captures] == ["a_sequence", "b_sequence"]
    assert [photo.file.name for photo in captures[0].photos] == ["0.jpg", "1.jpg", "2.jpg"]
    view = captures[0].view(2)
    assert view.image.shape == (HEIGHT, WIDTH, 3)
    assert abs(int(view.image.mean()) - 20) <= 1
    assert view.mask is not None
    assert view.mask.sum() == 20 * 30
    box = view.box
    assert (box.x0, box.y0, box.x1, box.y1) == (20, 10, 50, 30)
    assert captures[0].photos[0].complete


@pytest.mark.parametrize(("kind", "unit"), [("ndc_isotropic", (20, 20)), ("ndc_norm_image_bounds", (30, 20))])
def test_a_point_is_seen_where_pytorch3d_puts_it(dataset, kind, unit):
    photo = next(iter(co3d.load_category(dataset(kind=kind), "cup"))).photos[0]
    point = np.array([[0.3, -0.2, 0.5]])
    local = point @ R + T
    ndc = FOCAL * local[0, :2] / local[0, 2] + CENTRE  # x left, y up, from the image's centre
    expected = np.array([WIDTH, HEIGHT]) / 2 - ndc * unit
    pose = photo.camera_from_world
    np.testing.assert_allclose(project_points(point, pose[:, :3], pose[:, 3], photo.intrinsics)[0], expected)
    np.testing.assert_allclose(np.linalg.det(pose[:, :3]), 1)


def test_frames_without_camera_or_object_and_poor_sequences_are_left_out(dataset):
    root = dataset(empty=(0,), missing=(1,), frames=4)
    captures = list(co3d.load_category(root, "cup", min_quality=0.5))
    assert [capture.name for capture in captures] == ["a_sequence"]
    assert [photo.file.name for photo in captures[0].photos] == ["2.jpg", "3.jpg"]
    assert list(co3d.load_category(root, "cup", min_views=3)) == []


def test_what_is_missing_or_broken_is_named(dataset, tmp_path):
    with pytest.raises(CaptureError, match=r"sequence_annotations\.jgz"):
        list(co3d.load_category(tmp_path, "teapot"))
    root = dataset()
    (root / "cup" / "frame_annotations.jgz").write_bytes(b"no gzip")
    with pytest.raises(CaptureError, match=r"frame_annotations\.jgz"):
        list(co3d.load_category(root, "cup"))


def test_an_unknown_camera_model_is_refused(dataset):
    with pytest.raises(CaptureError, match="frame 0 of a_sequence"):
        list(co3d.load_category(dataset(kind="fisheye"), "cup"))


def test_the_split_is_41_and_10():
    assert len(set(co3d.TRAINING_CATEGORIES)) == 41
    assert len(set(co3d.HELD_OUT_CATEGORIES)) == 10
    assert not set(co3d.TRAINING_CATEGORIES) & set(co3d.HELD_OUT_CATEGORIES)
