"""Fits how far matches are to be trusted, on captures whose poses are known.

`benchmarks/match_trust.py` prints what stands in `relpose_ros.inference.matches`: the logistic regressions of
`trust`, and the two numbers by which the covariance of a matched rotation is widened.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.inference.local_features import find_features
from relpose_ros.inference.matches import TRUST
from relpose_ros.inference.two_view_poses import explain

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.captures.folder import Capture
    from relpose_ros.inference.estimator import Estimator

    FloatArray = npt.NDArray[np.float64]

RIGHT = math.radians(10)
"""A pose counts as right up to this error of its rotation."""
RIDGE = 0.05
"""Weight of the squared coefficients: a few captures must not make anything look certain."""


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


def observe(capture: Capture, estimator: Estimator | None = None, *, masked: bool) -> MatchedPairs:
    """Match every pair of a capture's posed photos.

    Beside a network those pairs are left out that `explain` asked SIFT alone about: their trust is SIFT's.

    Args:
        capture: folder of photos.
        estimator: whose network speaks beside SIFT; None for SIFT alone.
        masked: whether the masks on file count.
    """
    photos = [k for k, photo in enumerate(capture.photos) if photo.camera_from_world is not None]
    views = [capture.view(k, masked=masked) for k in photos]
    features = [
        find_features(view, None if estimator is None else estimator.descriptor_map(view)) for view in views
    ]
    rotations = [np.asarray(capture.photos[k].camera_from_world)[:, :3] for k in photos]
    signs, right, errors, covariances = [], [], [], []
    for i in range(len(photos)):
        for j in range(i + 1, len(photos)):
            explained = explain(features[i], features[j])
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


def fit_trust(pairs: MatchedPairs) -> FloatArray:
    """Logistic regression by Newton's method. -> (1 + F,) `relpose_ros.inference.matches.TRUST`."""
    design = np.concatenate([np.ones((len(pairs.right), 1)), pairs.signs], 1)
    coefficients = np.zeros(design.shape[1])
    penalty = RIDGE * np.diag(np.arange(design.shape[1]) > 0)
    for _ in range(30):
        chance = 1 / (1 + np.exp(-design @ coefficients))
        slope = design.T @ (pairs.right - chance) - penalty @ coefficients
        curvature = (design * (chance * (1 - chance))[:, None]).T @ design + penalty
        coefficients = coefficients + np.linalg.solve(curvature, slope)
    return np.asarray(coefficients)
