"""Whether what estimates say of their own errors holds: probabilities, covariances and verdicts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.estimates import Evidence, Verdict
from relpose_ros.evaluation.calibration_fit import (
    LEVELS,
    coverage,
    expected_calibration_error,
    mahalanobis_square,
)
from relpose_ros.geometry import cameras, so3
from relpose_ros.inference.outlines import find_outline, sightlines
from relpose_ros.inference.uncertainty import WITHIN

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from relpose_ros.estimates import ScanEstimate
    from relpose_ros.views import View

    FloatArray = npt.NDArray[np.float64]

SHOWN = {
    "stated@15": "stated@15",
    "strongest@15": "right@15",
    "calibration_error@15": "error",
    "matched_pairs": "matched",
    "matched_stated@15": "their stated",
    "matched_strongest@15": "right",
    "matched_calibration_error@15": "error",
    "pairs_inside@90": "pairs in 90",
    "rotations_inside@90": "rotations",
    "positions_inside@90": "positions",
    "enough": "enough",
    "enough_wrong": "and wrong",
}
"""The columns of a table, and their heads; after the share of pairs that matches speak of, those alone."""


@dataclass(frozen=True, eq=False)
class Statements:
    """What one estimate says of its errors, beside these errors."""

    stated: FloatArray
    """(P,) probability of each pair that its strongest mode is within 15 degrees of the truth."""
    right: npt.NDArray[np.bool_]
    """(P,) whether it is."""
    matched: npt.NDArray[np.bool_]
    """(P,) whether matches are among what it rests on."""
    pair_squares: FloatArray
    """(P,) squared errors of the strongest modes in units of the stated covariances."""
    rotation_squares: FloatArray
    """(N - 1,) the same of the cameras' rotations, the first left out, which is so by definition."""
    position_squares: FloatArray
    """(N - 1,) the same of their positions."""
    enough: bool
    """The verdict."""
    wrong: bool
    """Whether a relative rotation of the final poses is off by more than 15 degrees."""


def statements(
    estimate: ScanEstimate,
    views: Sequence[View],
    true_rotations: FloatArray,
    true_translations: FloatArray,
) -> Statements:
    """Holds an estimate's statements against the truth.

    Args:
        estimate: its unit of length the first camera's distance.
        views: the N views it was made of, whose boxes say where the origin of its frame is.
        true_rotations: (N, 3, 3) camera_from_world, any world.
        true_translations: (N, 3), any unit.
    """
    seen = sightlines([find_outline(view) for view in views])
    about_object, _, _ = cameras.look_at_translations(true_rotations, true_translations, seen)
    truth = true_rotations @ true_rotations[0].T  # camera_from_object, axes of the first camera
    true_centres = cameras.camera_centre(truth, about_object)
    pair_squares, right, final = [], [], []
    for pair in estimate.pairs:
        true = truth[pair.j] @ truth[pair.i].T
        error = so3.log(true @ pair.camera_j_from_camera_i.T)
        pair_squares.append(mahalanobis_square(error, pair.covariance))
        right.append(np.linalg.norm(error) < WITHIN)
        of_i, of_j = estimate.cameras[pair.i], estimate.cameras[pair.j]
        final.append(so3.angle_between(of_j.object_from_camera.T @ of_i.object_from_camera, true))
    rotation_squares, position_squares = [], []
    for camera in estimate.cameras[1:]:
        turn = so3.log(truth[camera.view].T @ camera.object_from_camera.T)  # axes of the object
        rotation_squares.append(mahalanobis_square(turn, camera.covariance[3:, 3:]))
        shift = true_centres[camera.view] - camera.position
        position_squares.append(mahalanobis_square(shift, camera.covariance[:3, :3]))
    return Statements(
        stated=np.array([pair.probability_within_15_deg for pair in estimate.pairs]),
        right=np.array(right),
        matched=np.array([Evidence.GEOMETRIC in pair.evidence for pair in estimate.pairs]),
        pair_squares=np.array(pair_squares),
        rotation_squares=np.array(rotation_squares),
        position_squares=np.array(position_squares),
        enough=estimate.verdict is Verdict.ENOUGH,
        wrong=bool(np.max(final) > WITHIN),
    )


def summary(group: Sequence[Statements]) -> dict[str, float]:
    """Figures of many scans' statements, all from 0 to 1.

    ``stated@15`` and ``strongest@15`` are equal on average where probabilities hold, and
    ``calibration_error@15`` is their mean distance over bins of the stated one. Of the share
    ``matched_pairs``, of which matches speak, the same three with ``matched_`` before them, where there are
    any. ``pairs_inside@90``,
    ``rotations_inside@90`` and ``positions_inside@90`` are the shares of errors inside the 90 %
    ellipsoids (likewise 50 and 95). ``enough`` is the share of scans that are called enough, and
    ``enough_wrong`` of those that are called so although a pair is off by more than 15 degrees.
    """
    stated = np.concatenate([each.stated for each in group])
    right = np.concatenate([each.right for each in group])
    matched = np.concatenate([each.matched for each in group])
    figures = {
        **_calibration(stated, right),
        "matched_pairs": float(matched.mean()),
        "enough": float(np.mean([each.enough for each in group])),
        "enough_wrong": float(np.mean([each.enough and each.wrong for each in group])),
    }
    if matched.any():
        of_matched = _calibration(stated[matched], right[matched])
        figures |= {f"matched_{name}": figure for name, figure in of_matched.items()}
    for name, squares in (
        ("pairs", [each.pair_squares for each in group]),
        ("rotations", [each.rotation_squares for each in group]),
        ("positions", [each.position_squares for each in group]),
    ):
        for level, share in zip(LEVELS, coverage(np.concatenate(squares)), strict=True):
            figures[f"{name}_inside@{100 * level:g}"] = share
    return figures


def _calibration(stated: FloatArray, right: npt.NDArray[np.bool_]) -> dict[str, float]:
    return {
        "stated@15": float(stated.mean()),
        "strongest@15": float(right.mean()),
        "calibration_error@15": expected_calibration_error(stated, right),
    }
