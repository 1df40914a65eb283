"""CO3Dv2 (Reizenstein et al., ICCV 2021): its annotations as captures, and the split of RelPose++.

Nothing is downloaded or copied: a capture names the files of the dataset where they lie.
"""

from __future__ import annotations

import gzip
import json
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from relpose_ros.captures.folder import Capture, CaptureError, Photo
from relpose_ros.views import BoundingBox, Intrinsics

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]

HELD_OUT_CATEGORIES = (
    "ball",
    "book",
    "couch",
    "frisbee",
    "hotdog",
    "kite",
    "remote",
    "sandwich",
    "skateboard",
    "suitcase",
)
"""The ten that RelPose and RelPose++ are measured on as unseen."""
# fmt: off
TRAINING_CATEGORIES = (
    "apple", "backpack", "banana", "baseballbat", "baseballglove", "bench", "bicycle", "bottle", "bowl",
    "broccoli", "cake", "car", "carrot", "cellphone", "chair", "cup", "donut", "hairdryer", "handbag",
    "hydrant", "keyboard", "laptop", "microwave", "motorcycle", "mouse", "orange", "parkingmeter", "pizza",
    "plant", "stopsign", "teddybear", "toaster", "toilet", "toybus", "toyplane", "toytrain", "toytruck", "tv",
    "umbrella", "vase", "wineglass",
)
# fmt: on
"""The other forty-one."""
FRAME_ANNOTATIONS, SEQUENCE_ANNOTATIONS = "frame_annotations.jgz", "sequence_annotations.jgz"
"""The files that every category's folder holds."""
MASK_THRESHOLD = 0.4
"""A pixel belongs to the box from this probability on; the masks are soft."""
_FLIP = np.array([-1.0, -1.0, 1.0])


def load_category(
    root: Path, category: str, *, min_quality: float = -np.inf, min_views: int = 2
) -> Iterator[Capture]:
    """The sequences of one category, in order of their names.

    A frame without a camera, or whose mask is empty, is left out. The masks are read for the boxes
    of a sequence when it is asked for.

    Args:
        root: The dataset's folder, which holds a folder a category.
        category: Its name.
        min_quality: Least ``viewpoint_quality_score`` of a sequence.
        min_views: Sequences with fewer usable frames are left out.

    Raises:
        CaptureError: The category or its annotations are missing or make no sense.
    """
    folder = Path(root) / category
    sequences = _annotations(folder / SEQUENCE_ANNOTATIONS)
    frames = _annotations(folder / FRAME_ANNOTATIONS)
    good = {
        entry["sequence_name"]
        for entry in sequences
        if float(entry.get("viewpoint_quality_score") or 0.0) >= min_quality
    }
    by_sequence: dict[str, list[dict[str, Any]]] = {}
    for frame in frames:
        if frame.get("sequence_name") in good:
            by_sequence.setdefault(frame["sequence_name"], []).append(frame)
    for name, entries in sorted(by_sequence.items()):
        entries.sort(key=lambda entry: int(entry["frame_number"]))
        photos = tuple(photo for entry in entries if (photo := _photo(Path(root), entry)) is not None)
        if len(photos) >= min_views:
            yield Capture(folder=folder / name, photos=photos)


def _annotations(path: Path) -> list[dict[str, Any]]:
    try:
        with gzip.open(path, "rt", encoding="utf-8") as stream:
            content = json.load(stream)
    except (OSError, ValueError, EOFError, zlib.error) as err:
        text = f"{path} cannot be read ({err}); a category of CO3Dv2 has frame_ and sequence_annotations.jgz."
        raise CaptureError(text) from err
    if not isinstance(content, list):
        text = f"{path} holds no list of annotations."
        raise CaptureError(text)
    return content


def _photo(root: Path, entry: dict[str, Any]) -> Photo | None:
    try:
        height, width = (int(side) for side in entry["image"]["size"])
        file = root / entry["image"]["path"]
        mask = root / entry["mask"]["path"] if (entry.get("mask") or {}).get("path") else None
        viewpoint = entry.get("viewpoint")
        pose = None if viewpoint is None else _camera_from_world(viewpoint)
        intrinsics = None if viewpoint is None else _intrinsics(viewpoint, width, height)
    except (KeyError, TypeError, ValueError) as err:
        text = f"frame {entry.get('frame_number')} of {entry.get('sequence_name')} makes no sense ({err!r})."
        raise CaptureError(text) from err
    box = None if pose is None or mask is None else _box(mask, width, height)
    if box is None:
        return None
    return Photo(
        file=file,
        mask=mask,
        width=width,
        height=height,
        box=box,
        intrinsics=intrinsics,
        camera_from_world=pose,
        complete=box.x0 > 0 and box.y0 > 0 and box.x1 < width and box.y1 < height,
        source=entry["image"]["path"],
    )


def _camera_from_world(viewpoint: dict[str, Any]) -> FloatArray:
    """(3, 4) optical, of PyTorch3D's row vectors and axes (x left, y up): F R^T and F t."""
    rotation, translation = np.asarray(viewpoint["R"], np.float64), np.asarray(viewpoint["T"], np.float64)
    pose = np.column_stack([_FLIP[:, None] * rotation.T, _FLIP * translation])
    if pose.shape != (3, 4) or not np.isfinite(pose).all():
        text = f"R and T have the shapes {rotation.shape} and {translation.shape}"
        raise ValueError(text)
    return pose


def _intrinsics(viewpoint: dict[str, Any], width: int, height: int) -> Intrinsics:
    """Pixels of PyTorch3D's normalised device coordinates, whose unit is half an image side.

    ``ndc_isotropic`` takes the shorter side for both directions, ``ndc_norm_image_bounds`` each its own.
    """
    kind = viewpoint.get("intrinsics_format", "ndc_norm_image_bounds")
    if kind == "ndc_isotropic":
        unit = np.array([min(width, height)] * 2) / 2
    elif kind == "ndc_norm_image_bounds":
        unit = np.array([width, height]) / 2
    else:
        text = f"unknown intrinsics_format {kind!r}"
        raise ValueError(text)
    focal = np.asarray(viewpoint["focal_length"], np.float64) * unit
    centre = np.array([width, height]) / 2 - np.asarray(viewpoint["principal_point"], np.float64) * unit
    return Intrinsics(fx=float(focal[0]), fy=float(focal[1]), cx=float(centre[0]), cy=float(centre[1]))


def _box(mask: Path, width: int, height: int) -> BoundingBox | None:
    """Extent of the mask, None where it is empty."""
    import cv2

    pixels = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
    if pixels is None or pixels.shape != (height, width):
        text = f"{mask} is no mask of {width} x {height} pixels."
        raise CaptureError(text)
    rows, columns = np.nonzero(pixels > MASK_THRESHOLD * 255)
    if len(rows) == 0:
        return None
    return BoundingBox(
        x0=float(columns.min()), y0=float(rows.min()), x1=float(columns.max() + 1), y1=float(rows.max() + 1)
    )
