"""Cameras that look at an object: centres, projection, and the look-at world frame.

Optical frames (x right, y down, z forward), column vectors: ``x_camera = R x_world + t`` with
``R = camera_from_world``. Any unit of length.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.views import Intrinsics

    FloatArray = npt.NDArray[np.float64]


def homogeneous(rays: npt.ArrayLike) -> FloatArray:
    """Rays (x / z, y / z) as points at depth 1. (..., 2) -> (..., 3)."""
    r = np.asarray(rays, np.float64)
    return np.concatenate([r, np.ones_like(r[..., :1])], -1)


def directions(rays: npt.ArrayLike) -> FloatArray:
    """Rays (x / z, y / z) as unit vectors. (..., 2) -> (..., 3)."""
    points = homogeneous(rays)
    return np.asarray(points / np.linalg.norm(points, axis=-1, keepdims=True))


def camera_centre(camera_from_world: npt.ArrayLike, translation: npt.ArrayLike) -> FloatArray:
    """Where the camera stands in the world: ``-R^T t``. (..., 3, 3), (..., 3) -> (..., 3)."""
    return -in_world(camera_from_world, translation)


def translation_of(camera_from_world: npt.ArrayLike, centre: npt.ArrayLike) -> FloatArray:
    """The translation of a camera that stands at ``centre``: ``-R c``. (..., 3, 3), (..., 3) -> (..., 3)."""
    r, c = np.asarray(camera_from_world, np.float64), np.asarray(centre, np.float64)
    return np.asarray(-np.einsum("...ij,...j->...i", r, c))


def in_world(camera_from_world: npt.ArrayLike, local: npt.ArrayLike) -> FloatArray:
    """Directions in the cameras' axes as the world has them: ``R^T d``. (..., 3, 3), (..., 3) -> (..., 3)."""
    r, d = np.asarray(camera_from_world, np.float64), np.asarray(local, np.float64)
    return np.asarray(np.einsum("...ji,...j->...i", r, d))


def look_at(centre: npt.ArrayLike, target: npt.ArrayLike, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> FloatArray:
    """camera_from_world of a camera at ``centre`` looking at ``target``, the top of its image towards ``up``.

    (..., 3) each -> (..., 3, 3). A camera that looks along ``up`` has no preferred roll and gets any.
    """
    c, p = np.broadcast_arrays(np.asarray(centre, np.float64), np.asarray(target, np.float64))
    forward = p - c
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, np.broadcast_to(np.asarray(up, np.float64), c.shape))
    length = np.linalg.norm(right, axis=-1, keepdims=True)
    spare = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward), -1)])
    right = np.where(length > 1e-9, right, spare)
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], -2)


def project_points(
    points: npt.ArrayLike,
    camera_from_world: npt.ArrayLike,
    translation: npt.ArrayLike,
    intrinsics: Intrinsics,
) -> FloatArray:
    """Pixels (corner convention of `relpose_ros.views`) of world points in one camera. (M, 3) -> (M, 2).

    Points on or behind the camera's plane come out as nan.
    """
    local = np.asarray(points, np.float64) @ np.asarray(camera_from_world, np.float64).T
    local = local + np.asarray(translation, np.float64)
    depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
    u = intrinsics.fx * local[:, 0] / depth + intrinsics.cx
    v = intrinsics.fy * local[:, 1] / depth + intrinsics.cy
    return np.stack([u, v], -1)


def closest_point_to_rays(rays: npt.ArrayLike, centres: npt.ArrayLike, held: float = 0.0) -> FloatArray:
    """The point with the least summed squared distance to the lines through the camera centres.

    Unit directions (..., N, 3) in the world and centres (..., N, 3) -> (..., 3). Parallel lines leave it free
    along themselves: there the answer is the point nearest to the mean of the camera centres. The squared
    distance to the world's origin counts ``held`` times as much as one to a line.
    """
    r, c = np.asarray(rays, np.float64), np.asarray(centres, np.float64)
    middle = c.mean(-2)
    across = np.eye(3) - r[..., :, None] * r[..., None, :]  # keeps what is perpendicular to the ray
    wanted = (across @ (c - middle[..., None, :])[..., None]).sum(-3)
    wanted = wanted - held * middle[..., None]
    offset = np.linalg.pinv(across.sum(-3) + held * np.eye(3), rcond=1e-9, hermitian=True) @ wanted
    return np.asarray(middle + offset[..., 0])


def closest_point_to_axes(camera_from_world: npt.ArrayLike, centres: npt.ArrayLike) -> FloatArray:
    """The point closest to all optical axes (RelPose++, 3.3). (..., N, 3, 3), (..., N, 3) -> (..., 3)."""
    return closest_point_to_rays(np.asarray(camera_from_world, np.float64)[..., 2, :], centres)


def look_at_translations(
    camera_from_world: npt.ArrayLike,
    translations: npt.ArrayLike,
    sightlines: npt.ArrayLike = (0.0, 0.0, 1.0),
) -> tuple[FloatArray, FloatArray, float]:
    """Translations about the look-at point, first camera at distance 1: what the network learns to predict.

    With ``x = x' + c`` and c the point closest to all axes, ``R x + t = R x' + (t + R c)``: the origin
    moves to c by adding R c (RelPose++ prints a minus).

    Args:
        camera_from_world: (N, 3, 3).
        translations: (N, 3), any unit.
        sightlines: (N, 3) unit vectors in the cameras' axes, along which each looks at the point; the
            optical axes, as in training, where they are left out.

    Returns:
        (N, 3) ``s (t_i + R_i c)``, the point c (3,) in the old world, and s, with ``|t_1| = 1``.
    """
    r, t = np.asarray(camera_from_world, np.float64), np.asarray(translations, np.float64)
    rays = in_world(r, np.broadcast_to(np.asarray(sightlines, np.float64), t.shape))
    point = closest_point_to_rays(rays, camera_centre(r, t))
    moved = t + r @ point
    scale = 1 / float(np.linalg.norm(moved[0]))
    return moved * scale, point, scale


def first_camera_translations(camera_from_world: npt.ArrayLike, translations: npt.ArrayLike) -> FloatArray:
    """The same targets in the first camera's frame: ``t_i - R_i R_1^T t_1``, in the look-at unit. -> (N, 3).

    The unit stays the first camera's distance to the look-at point, so that the two choices of
    origin (an ablation of RelPose++) can be compared.
    """
    r, t = np.asarray(camera_from_world, np.float64), np.asarray(translations, np.float64)
    _, _, scale = look_at_translations(r, t)
    return np.asarray((t + r @ camera_centre(r[0], t[0])) * scale)
