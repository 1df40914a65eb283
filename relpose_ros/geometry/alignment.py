"""Best alignments of an estimate to the truth: similarity, rotation, and the translation protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.geometry import so3

if TYPE_CHECKING:
    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Similarity:
    """``target = scale * rotation @ source + translation``."""

    scale: float
    rotation: FloatArray
    """(3, 3)."""
    translation: FloatArray
    """(3,)."""

    def apply(self, points: npt.ArrayLike) -> FloatArray:
        """Source points in the target frame. (..., 3) -> (..., 3)."""
        return np.asarray(self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation)


def align_points(source: npt.ArrayLike, target: npt.ArrayLike) -> Similarity:
    """The similarity with the least squared error from source to target points (Umeyama 1991).

    Never a reflection: a mirrored configuration gets the best proper rotation and keeps an error.
    Coincident source points have no scale and get 0; collinear ones leave the rotation about their line free.

    Args:
        source: (N, 3).
        target: (N, 3), in the same order.
    """
    x, y = np.asarray(source, np.float64), np.asarray(target, np.float64)
    x_mean, y_mean = x.mean(0), y.mean(0)
    spread = (y - y_mean).T @ (x - x_mean)
    rotation = so3.project(spread)
    variance = float(((x - x_mean) ** 2).sum())
    scale = max(0.0, float(np.trace(rotation.T @ spread))) / variance if variance > 0 else 0.0
    return Similarity(scale, rotation, y_mean - scale * rotation @ x_mean)


def align_rotations(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> FloatArray:
    """The rotation Q of the world that brings ``estimate_i @ Q`` closest to ``truth_i`` (chordal).

    Both (N, 3, 3) camera_from_world, each in a world of its own: Q, (3, 3), is estimate_from_truth_world.
    """
    e, t = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    return so3.project(np.einsum("nji,njk->ik", e, t))


def align_translations(
    estimate: npt.ArrayLike, camera_from_world: npt.ArrayLike, truth: npt.ArrayLike
) -> tuple[float, FloatArray]:
    """Scale s and shift c of the world with the least ``sum |estimate_i - (s t_i + R_i c)|^2``.

    The translation error of RelPose++'s evaluation: linear least squares in four unknowns.

    Args:
        estimate: (N, 3) predicted translations.
        camera_from_world: (N, 3, 3) true rotations.
        truth: (N, 3) true translations.

    Returns:
        s and c (3,).
    """
    wanted = np.asarray(estimate, np.float64).reshape(-1)
    t = np.asarray(truth, np.float64).reshape(-1, 1)
    r = np.asarray(camera_from_world, np.float64).reshape(-1, 3)
    solution, *_ = np.linalg.lstsq(np.concatenate([t, r], 1), wanted, rcond=None)
    return float(solution[0]), np.asarray(solution[1:])
