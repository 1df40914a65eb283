"""Where a camera sees the object, by the box around it.

Rays are (x / z, y / z) of the pinhole camera, as they were before a lens bent them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from relpose_ros.geometry import cameras
from relpose_ros.views import Intrinsics

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from relpose_ros.views import Distortion, View

    FloatArray = npt.NDArray[np.float64]

WIDEST_RAY = 20.0
"""Of a ray's coordinates, 87 degrees off the axis: so far out no calibration holds. OpenCV gives a million
where it finds no ray that the lens would have bent to a pixel."""
AHEAD = np.array([0.0, 0.0, 1.0])
SIZE_SHARE = 0.5
"""Of the logarithm of an object's apparent size, what is due to the camera's distance: the rest is that an
object has no two sides alike. Fitted on the photographs and renderings that the shipped network was trained
on: the distances are 9 per cent off, and 11 were they taken for all the same."""
UNSIGHTED_SIGMA = (0.1, 0.2)
"""As `position_sigmas` has them, of a camera of which nobody says where in its picture the object is: a hand
holds it within a few degrees of the middle, and at much the same distance."""
GUESSED_FOCAL_DEVIATION = 0.2
"""Relative standard deviation of a guessed focal length."""


@dataclass(frozen=True, eq=False)
class Outline:
    """The object's box as a camera sees it."""

    middle: FloatArray
    """(3,) unit vector in the camera's axes, right, down and ahead."""
    sides: FloatArray
    """(2,) angles, rad, that width and height take up; NaN where no rays are known of an edge."""
    guessed: bool = False
    """Whether the intrinsics are a guess."""


def find_outline(view: View) -> Outline | None:
    """Of a view's box; its intrinsics are guessed from the size of the image where it has none.

    None where the box is the whole picture, which says nothing of the object, or where no ray is known of its
    middle. In angles an object looks alike wherever in the picture it is.
    """
    box = view.box
    if box.x0 <= 0 and box.y0 <= 0 and box.x1 >= view.full_width and box.y1 >= view.full_height:
        return None
    x, y = (box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2
    rays = rays_of(view, np.array([[box.x0, y], [box.x1, y], [x, box.y0], [x, box.y1], [x, y]]))
    known = known_rays(rays)
    edges, middle = np.split(cameras.directions(rays), [4])
    if not known[4]:
        return None
    if not known.all():
        return Outline(middle[0], np.full(2, np.nan), view.intrinsics is None)
    across = np.clip((edges[0::2] * edges[1::2]).sum(1), -1, 1)
    together = edges.sum(0)
    return Outline(together / np.linalg.norm(together), np.arccos(across), view.intrinsics is None)


def sightlines(outlines: Sequence[Outline | None]) -> FloatArray:
    """Unit vectors towards the object in the cameras' axes; ahead where no box tells. -> (N, 3)."""
    return np.stack([AHEAD if outline is None else outline.middle for outline in outlines])


def sighted_translations(outlines: Sequence[Outline | None]) -> FloatArray:
    """Where the boxes place the object's middle in each camera's axes, the first camera at distance 1.

    The direction is the box's. Of the apparent sizes half says how far cameras are from the object
    (`SIZE_SHARE`); one without a size is as far as the others on average.

    Returns:
        (N, 3): translations camera_from_object, the object's middle its origin.
    """
    sizes = np.array([np.nan if outline is None else outline.sides.prod() ** 0.5 for outline in outlines])
    known = np.isfinite(sizes) & (sizes > 0)
    nearness = np.zeros(len(sizes))
    if known.any():
        nearness[known] = np.log(sizes[known]) - np.log(sizes[known]).mean()
    distances = np.exp(-SIZE_SHARE * nearness)
    return np.asarray(distances[:, None] / distances[0] * sightlines(outlines))


def position_sigmas(outlines: Sequence[Outline | None], sigma: tuple[float, float]) -> FloatArray:
    """Standard deviations of where each camera stands from the object, across its line of sight and along it.

    Args:
        outlines: of the N views.
        sigma: of a view whose box and intrinsics are known.

    Returns:
        (N, 2) in units of the first camera's distance.
    """
    sigmas = np.tile(np.asarray(sigma, np.float64), (len(outlines), 1))
    for own, outline in zip(sigmas, outlines, strict=True):
        if outline is None:
            own[:] = np.maximum(own, UNSIGHTED_SIGMA)
            continue
        if not np.isfinite(outline.sides).all():
            own[1] = max(own[1], UNSIGHTED_SIGMA[1])
        if outline.guessed:
            # A wrong focal length turns the line of sight in proportion to its angle from the axis.
            own[0] = np.hypot(own[0], GUESSED_FOCAL_DEVIATION * np.arccos(outline.middle[2]))
    return sigmas


def focal_lengths(view: View) -> FloatArray:
    """Along x and y, pixels; guessed where the camera said nothing. -> (2,)."""
    intrinsics = _intrinsics(view)
    return np.array([intrinsics.fx, intrinsics.fy], np.float64)


def rays_of(view: View, pixels: FloatArray) -> FloatArray:
    """Rays of pixels (K, 2) of the full image; `known_rays` tells which are to be believed."""
    intrinsics = _intrinsics(view)
    middle = np.array([intrinsics.cx, intrinsics.cy])
    return _straightened(np.asarray((pixels - middle) / focal_lengths(view)), view.distortion)


def known_rays(rays: FloatArray) -> npt.NDArray[np.bool_]:
    """Which rays (K, 2) the lens's model tells."""
    return np.asarray((np.abs(rays) < WIDEST_RAY).all(1))


def _intrinsics(view: View) -> Intrinsics:
    return view.intrinsics or Intrinsics.guessed(view.full_width, view.full_height)


def _straightened(rays: FloatArray, distortion: Distortion | None) -> FloatArray:
    """Rays (K, 2) as they were before the lens bent them."""
    if distortion is None or len(rays) == 0:
        return rays
    import cv2

    bent, coefficients = rays[:, None], np.array(distortion.coefficients)
    if distortion.equidistant:
        straight: Any = cv2.fisheye.undistortPoints(bent, np.eye(3), coefficients)
    else:
        # Five iterations, the default, leave pixels of error in the corners of a wide picture. OpenCV 4 lets
        # a function of another name have more.
        undo: Any = vars(cv2).get("undistortPointsIter", cv2.undistortPoints)
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
        straight = undo(bent, np.eye(3), coefficients, R=None, P=None, criteria=criteria)
    return np.asarray(straight[:, 0], np.float64)
