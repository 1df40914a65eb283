"""Fits how far matches are to be trusted, on captures whose poses are known.

For matches that a network's descriptors helped to, `relpose_ros.evaluation.calibrate` keeps what comes of
it with the weights. For SIFT's, `benchmarks/match_trust.py` prints the constants of
`relpose_ros.inference.matches`, with the two numbers that widen the covariance of a matched rotation.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.evaluation.calibration_fit import expected_calibration_error
from relpose_ros.geometry import so3
from relpose_ros.inference.local_features import find_features
from relpose_ros.inference.matches import TRUST, trust_of_signs
from relpose_ros.inference.side_by_side import side_by_side
from relpose_ros.inference.two_view_poses import explain

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from relpose_ros.captures.folder import Capture
    from relpose_ros.inference.estimator import Estimator
    from relpose_ros.views import View

    FloatArray = npt.NDArray[np.float64]

RIGHT = math.radians(10)
"""A pose counts as right up to this error of its rotation."""
RIDGE = 0.05
"""Weight of the squared coefficients: a few captures must not make anything look certain."""
LEAST_OF_EACH = 20
"""Pairs that were right, and as many that were not: of fewer nothing is learned."""


@dataclass(frozen=True, eq=False)
class MatchedPairs:
    """Statistics of matched pairs and whether they were right."""

    signs: FloatArray
    """(Q, F) `Support.signs` of each pair."""
    right: npt.NDArray[np.bool_]
    """(Q,)."""
    errors: FloatArray
    """(R, 3) rotation vectors from the right ones among them to the truth."""
    covariances: FloatArray
    """(R, 3, 3) that they stated."""

    @classmethod
    def joined(cls, parts: Sequence[MatchedPairs]) -> MatchedPairs:
        """Those of all parts, one or more."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))


@dataclass(frozen=True)
class TrustReport:
    """How well stated trust holds on some pairs."""

    pairs: int
    """That matched."""
    right: float
    """Share of them."""
    stated: float
    """Mean of what was stated."""
    expected_calibration_error: float
    """Of that, 0 to 1."""


def observe(views: Sequence[View], rotations: FloatArray, estimator: Estimator | None = None) -> MatchedPairs:
    """Match every pair of some views whose cameras are known.

    Beside a network those pairs are left out that `explain` asked SIFT alone about: their trust is SIFT's.

    Args:
        views: N, of one object.
        rotations: (N, 3, 3) camera_from_object.
        estimator: whose network speaks beside SIFT; None for SIFT alone.
    """
    maps = [None if estimator is None else estimator.descriptor_map(view) for view in views]
    features = side_by_side(lambda k: find_features(views[k], maps[k]), range(len(views)))
    pairs = list(itertools.combinations(range(len(views)), 2))
    found = side_by_side(lambda pair: explain(*(features[view] for view in pair)), pairs)
    signs, right, errors, covariances = [], [], [], []
    for (i, j), explained in zip(pairs, found, strict=True):
        if explained is None or explained.support.learned is not features[i].learned:
            continue
        truth = rotations[j] @ rotations[i].T
        turns = [so3.log(truth @ pose.rotation.T) for pose in explained.poses]
        best = int(np.argmin([np.linalg.norm(turn) for turn in turns]))
        signs.append(explained.support.signs)
        right.append(bool(np.linalg.norm(turns[best]) < RIGHT))
        if right[-1]:
            errors.append(turns[best])
            covariances.append(explained.poses[best].covariance)
    return MatchedPairs(
        np.array(signs).reshape(-1, len(TRUST) - 1),
        np.array(right, bool),
        np.array(errors).reshape(-1, 3),
        np.array(covariances).reshape(-1, 3, 3),
    )


def observe_capture(capture: Capture, estimator: Estimator | None = None, *, masked: bool) -> MatchedPairs:
    """`observe` of a capture's posed photos.

    Args:
        capture: folder of photos.
        estimator: of `observe`.
        masked: whether the masks on file count.
    """
    poses = {k: photo.camera_from_world for k, photo in enumerate(capture.photos)}
    known = {k: pose[:, :3] for k, pose in poses.items() if pose is not None}
    views = [capture.view(k, masked=masked) for k in known]
    return observe(views, np.array(list(known.values())).reshape(-1, 3, 3), estimator)


def fit_trust(pairs: MatchedPairs) -> tuple[float, ...] | None:
    """Logistic regression by Newton's method: coefficients of `relpose_ros.inference.matches.trust`.

    -> (1 + F,); None where too few pairs were right, or too few were not.
    """
    if min(np.count_nonzero(pairs.right), np.count_nonzero(~pairs.right)) < LEAST_OF_EACH:
        return None
    design = np.concatenate([np.ones((len(pairs.right), 1)), pairs.signs], 1)
    coefficients = np.zeros(design.shape[1])
    penalty = RIDGE * np.diag(np.arange(design.shape[1]) > 0)
    for _ in range(30):
        chance = 1 / (1 + np.exp(-design @ coefficients))
        slope = design.T @ (pairs.right - chance) - penalty @ coefficients
        curvature = (design * (chance * (1 - chance))[:, None]).T @ design + penalty
        coefficients = coefficients + np.linalg.solve(curvature, slope)
    return tuple(coefficients.tolist())


def measure_trust(pairs: MatchedPairs, coefficients: Sequence[float]) -> TrustReport | None:
    """What such coefficients are worth, best asked of other pairs; None where none matched."""
    if len(pairs.right) == 0:
        return None
    stated = np.array([trust_of_signs(signs, coefficients) for signs in pairs.signs])
    return TrustReport(
        pairs=len(stated),
        right=float(pairs.right.mean()),
        stated=float(stated.mean()),
        expected_calibration_error=expected_calibration_error(stated, pairs.right),
    )
