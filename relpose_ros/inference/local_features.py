"""Local features of a view, and which of two views' features belong together: SIFT (Lowe 2004).

Image coordinates are rays (x / z, y / z) of the pinhole camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from relpose_ros.views import Intrinsics

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.views import View

    FloatArray = npt.NDArray[np.float64]
    IntArray = npt.NDArray[np.int64]

MOST_FEATURES = 2500
LONGEST_SIDE = 800
"""Pixels: a larger part of an image is shrunk to it. Features of one more octave cost more than they add."""
LARGEST_SCALE = 2.0
"""A smaller part is enlarged, up to twice: SIFT finds little in a small crop as it is."""
CONTRAST = 0.01
"""A quarter of Lowe's: plain objects have few features of any contrast, and a bad one costs little."""
RATIO = 0.9
"""Largest distance of a match relative to the second best in either view (Lowe 2004), on root-normalised
descriptors."""
ROUNDING = 1e-5
"""Of a squared distance of descriptors."""


@dataclass(frozen=True, eq=False)
class LocalFeatures:
    """The local features of one view."""

    rays: FloatArray
    """(K, 2)."""
    orientations: FloatArray
    """(K,) rad, of the gradients that a feature's descriptor is relative to."""
    descriptors: npt.NDArray[np.float32]
    """(K, 128), unit length, root-normalised (Arandjelovic and Zisserman 2012)."""
    pixel: float
    """A pixel of the picture in which they were found, in units of ``rays``: the scale of their accuracy."""
    guessed: bool
    """Whether the intrinsics are a guess."""


def find_features(view: View, *, surroundings: bool = False) -> LocalFeatures:
    """SIFT features of the object, or of all the picture.

    Args:
        view: Its intrinsics are guessed from the size of the image where it has none.
        surroundings: Whether what lies outside the object's box and mask takes part. A static table helps a
            moving camera, and misleads where the object is what turns.
    """
    import cv2

    left, top, picture = _part(view, surroundings)
    scale = min(LARGEST_SCALE, LONGEST_SIDE / max(picture.shape[:2]))
    grey: Any = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    region: Any = None
    if view.mask is not None and not surroundings:
        rows, columns = slice(top, top + grey.shape[0]), slice(left, left + grey.shape[1])
        region = view.mask[rows, columns].astype(np.uint8)
    if scale != 1:
        size = (max(1, round(scale * grey.shape[1])), max(1, round(scale * grey.shape[0])))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        region = None if region is None else cv2.resize(region, size, interpolation=cv2.INTER_NEAREST)
    create: Any = vars(cv2)["SIFT_create"]  # in every version, and in no version's type stubs
    sift = create(nfeatures=MOST_FEATURES, contrastThreshold=CONTRAST)
    points, found = sift.detectAndCompute(grey, region)
    intrinsics = view.intrinsics or Intrinsics.guessed(view.full_width, view.full_height)
    descriptors = np.zeros((0, 128), np.float32) if found is None else found
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    # OpenCV's (0, 0) is the first pixel's centre.
    pixels = np.array([point.pt for point in points], np.float64).reshape(-1, 2) + 0.5
    # Sizes are whole: the sides may have been scaled a little differently.
    pixels *= [picture.shape[1] / grey.shape[1], picture.shape[0] / grey.shape[0]]
    pixels += [left + view.origin[0], top + view.origin[1]]
    focal = np.array([intrinsics.fx, intrinsics.fy])
    rays = (pixels - [intrinsics.cx, intrinsics.cy]) / focal
    orientations = np.radians([point.angle for point in points])
    return LocalFeatures(
        rays, orientations, descriptors, 1 / (scale * float(focal.mean())), view.intrinsics is None
    )


def match(first: LocalFeatures, second: LocalFeatures) -> IntArray:
    """Features that are each other's nearest, and much nearer than either's second. -> (M, 2) positions."""
    if len(first.descriptors) < 2 or len(second.descriptors) < 2:
        return np.zeros((0, 2), np.int64)
    likeness = first.descriptors @ second.descriptors.T
    best = likeness.argmax(1)
    rows = np.arange(len(likeness))
    highest = likeness[rows, best]
    likeness[rows, best] = -1
    chosen = rows[_apart(highest, likeness.max(1))]
    likeness[rows, best] = highest
    # The other way round for the few that are left alone: maxima down all columns are slow.
    columns = likeness[:, best[chosen]].T
    mutual = columns.argmax(1) == chosen
    columns[np.arange(len(chosen)), chosen] = -1
    chosen = chosen[mutual & _apart(highest[chosen], columns.max(1))]
    return np.stack([chosen, best[chosen]], 1)


def _apart(best: FloatArray, second: FloatArray) -> npt.NDArray[np.bool_]:
    """Lowe's ratio test, by inner products of unit descriptors: of two that look the same, none is nearer."""
    return np.asarray(2 - 2 * best + ROUNDING < RATIO**2 * (2 - 2 * second))


def _part(view: View, surroundings: bool) -> tuple[int, int, npt.NDArray[np.uint8]]:
    """Column, row (in ``view.image``) and pixels of where to look."""
    height, width = view.image.shape[:2]
    if surroundings:
        return 0, 0, view.image
    x, y = view.origin
    left, top = (
        min(max(round(view.box.x0 - x), 0), width - 1),
        min(max(round(view.box.y0 - y), 0), height - 1),
    )
    # One pixel at least, which has no features, as a box outside the image has none.
    right, bottom = max(round(view.box.x1 - x), left + 1), max(round(view.box.y1 - y), top + 1)
    return left, top, view.image[top:bottom, left:right]
