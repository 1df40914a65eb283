"""How wrong poses are: the numbers of RelPose++'s tables (section 4.2).

Poses are camera_from_world, optical frames, column vectors; an estimate may live in any world and any
unit. Each function gives one error per pair or camera; a camera without an estimate has infinite
errors, so that a method that gives up is counted, not skipped.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.geometry.alignment import align_points, align_translations
from relpose_ros.geometry.cameras import camera_centre

if TYPE_CHECKING:
    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]

ROTATION_THRESHOLDS = (5.0, 10.0, 15.0, 30.0)
"""Degrees."""
ROTATION_AREA_LIMIT = 60.0
"""Degrees."""
CENTER_THRESHOLDS = (0.1, 0.2, 0.3)
"""Fractions of the scene scale."""
CENTER_AREA_LIMIT = 0.4
"""Fraction of the scene scale."""
TRANSLATION_THRESHOLDS = (0.1,)
"""Fractions of the scene scale."""


def rotation_errors(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> FloatArray:
    """Angle between estimated and true relative rotation, of every ordered pair of cameras.

    Args:
        estimate: (N, 3, 3), nan where a camera has no estimate.
        truth: (N, 3, 3).

    Returns:
        (N (N - 1),) degrees; infinite where one of the two cameras has no estimate.
    """
    e, t = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    i, j = np.nonzero(~np.eye(len(t), dtype=bool))
    errors = np.full(len(i), np.inf)
    known = _known(e)[i] & _known(e)[j]
    i, j = i[known], j[known]
    errors[known] = np.degrees(
        so3.angle_between(e[j] @ e[i].transpose(0, 2, 1), t[j] @ t[i].transpose(0, 2, 1))
    )
    return errors


def scene_scale(centres: npt.ArrayLike) -> float:
    """Distance from the centroid of all cameras of a sequence to the furthest of them. (M, 3)."""
    c = np.asarray(centres, np.float64)
    return float(np.linalg.norm(c - c.mean(0), axis=1).max())


def center_errors(
    rotations: npt.ArrayLike,
    translations: npt.ArrayLike,
    true_rotations: npt.ArrayLike,
    true_translations: npt.ArrayLike,
    scale: float,
) -> FloatArray:
    """Distance of the camera centres to the true ones after the best similarity, by scene scale.

    Two cameras can always be aligned: at N = 2 every error is 0. Cameras without an estimate take no
    part in the alignment, and one alone has no place beside others: its error is infinite too.

    Args:
        rotations: (N, 3, 3), nan where a camera has no estimate.
        translations: (N, 3).
        true_rotations: (N, 3, 3).
        true_translations: (N, 3).
        scale: `scene_scale` of the whole sequence, in the unit of ``true_translations``.

    Returns:
        (N,) fractions of the scene scale.
    """
    r = np.asarray(rotations, np.float64)
    known = _known(r) & _known(translations)
    errors = np.full(len(r), np.inf)
    if known.sum() > 1:
        centres = camera_centre(r[known], np.asarray(translations, np.float64)[known])
        truth = camera_centre(np.asarray(true_rotations)[known], np.asarray(true_translations)[known])
        errors[known] = np.linalg.norm(align_points(centres, truth).apply(centres) - truth, axis=1) / scale
    return errors


def translation_errors(
    rotations: npt.ArrayLike, translations: npt.ArrayLike, true_translations: npt.ArrayLike, scale: float
) -> FloatArray:
    """Distance of ``s t_i + R_i c`` to the true translation, s and c the best, by scene scale.

    A new scale and origin of the estimate's world is all that is forgiven, and the residual is in the
    unit of the truth. Shapes and conventions as in `center_errors`.
    """
    r = np.asarray(rotations, np.float64)
    known = _known(r) & _known(translations)
    errors = np.full(len(r), np.inf)
    if known.sum() > 1:
        r, t = r[known], np.asarray(translations, np.float64)[known]
        truth = np.asarray(true_translations, np.float64)[known]
        s, c = align_translations(truth, r, t)
        errors[known] = np.linalg.norm(s * t + r @ c - truth, axis=1) / scale
    return errors


def accuracy(errors: npt.ArrayLike, threshold: float) -> float:
    """Fraction of the errors that do not exceed the threshold."""
    return float((np.asarray(errors) <= threshold).mean())


def area_under_curve(errors: npt.ArrayLike, limit: float) -> float:
    """Area under accuracy as a function of the threshold from 0 to ``limit``, over ``limit``: 0 to 1.

    Exact, without a grid of thresholds: an error e counts from threshold e on.
    """
    return float(np.clip(1 - np.asarray(errors, np.float64) / limit, 0, None).mean())


def summary(rotation: npt.ArrayLike, center: npt.ArrayLike, translation: npt.ArrayLike) -> dict[str, float]:
    """Every figure of the paper's tables from the errors of one or many scans.

    The errors are those of `rotation_errors` (degrees), `center_errors` and `translation_errors`.
    Keys read ``rotation@15``, ``rotation@auc60``, ``rotation@median``, ``center@0.1``, ``center@auc0.4``,
    ``translation@0.1``.
    """
    figures = {f"rotation@{threshold:g}": accuracy(rotation, threshold) for threshold in ROTATION_THRESHOLDS}
    figures[f"rotation@auc{ROTATION_AREA_LIMIT:g}"] = area_under_curve(rotation, ROTATION_AREA_LIMIT)
    # A method may have failed on most pairs: 180 is as wrong as a rotation can be, and JSON has no infinity.
    figures["rotation@median"] = float(np.median(np.minimum(np.asarray(rotation), 180.0)))
    figures |= {f"center@{threshold:g}": accuracy(center, threshold) for threshold in CENTER_THRESHOLDS}
    figures[f"center@auc{CENTER_AREA_LIMIT:g}"] = area_under_curve(center, CENTER_AREA_LIMIT)
    figures |= {
        f"translation@{threshold:g}": accuracy(translation, threshold) for threshold in TRANSLATION_THRESHOLDS
    }
    return figures


def _known(values: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Which cameras have an estimate: all entries finite. (N, ...) -> (N,)."""
    v = np.asarray(values, np.float64)
    return np.asarray(np.isfinite(v).reshape(len(v), -1).all(1))
