"""How far to trust what the matches of two views say of their relative pose, and what an energy has of it.

Features are found once per view, and a pair's geometry once per pair. Rotations and translations are optical
column-vector ``camera_j_from_camera_i``.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.inference.local_features import find_features
from relpose_ros.inference.rotation_evidence import Peak
from relpose_ros.inference.side_by_side import side_by_side
from relpose_ros.inference.two_view_poses import explain
from relpose_ros.inference.uncertainty import BASIN

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy.typing as npt

    from relpose_ros.inference.local_features import DescriptorMap, LocalFeatures
    from relpose_ros.inference.two_view_poses import RelativePose, Support
    from relpose_ros.views import View

    FloatArray = npt.NDArray[np.float64]
    IntArray = npt.NDArray[np.int64]

TRUST = (-7.98, 2.31, -3.15, 2.54)
"""Coefficients of `trust` for SIFT's matches: the bias, and those of `Support.signs`. Fitted by
`benchmarks/match_trust.py` on the photographs that the shipped network was trained on (ascott_hound, buddha,
socketed_axe) and on eight rendered captures of held-out objects, by boxes alone: photographs know few of the
plain and repetitive surfaces that accidental matches come from."""
LARGEST_TRUST = 0.995
"""No captures are enough to learn how rare the rarest mistakes are."""
WIDENING = 8.0
"""Factor on a matched rotation's covariance: errors of features near each other go together."""
MATCHING_FLOOR = math.radians(0.3)
"""Standard deviation, rad, of what no number of matches averages away: the intrinsics, above all."""
NEAR_MISSES = 0.15
"""Share of the poses, otherwise right, that shallow relief or few well-spread points leave further off."""
NEAR_MISS = math.radians(8)
"""How far, standard deviation in rad."""
AGREEMENT = math.radians(10)
"""Matches hold positions and points where their rotation and the cameras' agree to this, rad."""
LEAST_PROBABILITY = 0.5
"""Probability of a pair's poses from which on its matches count."""


@dataclass(frozen=True, eq=False)
class TwoViewGeometry:
    """What the matches of two views say. No poses, no opinion."""

    poses: tuple[RelativePose, ...]
    """Best first; empty where the matches say nothing."""
    inliers: IntArray
    """(M, 2) positions of matched features of view i and of view j that the first pose explains."""
    probability: float
    """That one of the poses is right (see `trust`)."""

    def agrees(self, rotation: FloatArray) -> bool:
        """Whether the best pose is trusted and has this rotation: then its points and direction count."""
        if not self.poses or self.probability * self.poses[0].weight < LEAST_PROBABILITY:
            return False
        return bool(so3.angle_between(rotation, self.poses[0].rotation) < AGREEMENT)

    def chance_of(self, rotation: FloatArray) -> float:
        """Probability of a pose with about this rotation, by the matches alone."""
        near = [pose for pose in self.poses if so3.angle_between(rotation, pose.rotation) < BASIN]
        return self.probability * sum(pose.weight for pose in near)


NOTHING = TwoViewGeometry((), np.zeros((0, 2), np.int64), 0.0)


def relate(
    first: LocalFeatures, second: LocalFeatures, *, learned_trust: Sequence[float] | None = None
) -> TwoViewGeometry:
    """The relative pose of two views by their matches, and how far it is to be trusted.

    Args:
        first: features of view i.
        second: features of view j.
        learned_trust: coefficients of `trust` where a network's descriptors helped to match.

    Raises:
        ValueError: they helped, and there are none.
    """
    found = explain(first, second)
    if found is None:
        return NOTHING
    coefficients = learned_trust if found.support.learned else TRUST
    if coefficients is None:
        raise ValueError("A network's descriptors helped to match; how far to trust that must be given.")
    places = np.stack([first.places[found.inliers[:, 0]], second.places[found.inliers[:, 1]]], 1)
    return TwoViewGeometry(found.poses, places, trust(found.support, coefficients))


def trust(support: Support, coefficients: Sequence[float] = TRUST) -> float:
    """Probability that one of a pair's poses is right, learned from pairs whose pose is known.

    Args:
        support: what speaks for the poses.
        coefficients: (4,) of the logistic regression; those of a network's descriptors are kept with its
            weights, as `Calibration.match_trust`.
    """
    return trust_of_signs(support.signs, coefficients)


def trust_of_signs(signs: FloatArray, coefficients: Sequence[float]) -> float:
    """`trust` by the numbers that it goes by, `Support.signs`."""
    bias, *slopes = coefficients
    return LARGEST_TRUST / (1 + math.exp(-(bias + float(signs @ slopes))))


class Matcher:
    """Finds the features of a view and the geometry of a pair once, for as long as the views are held."""

    def __init__(self, *, surroundings: bool = False, learned_trust: Sequence[float] | None = None) -> None:
        """Takes what `find_features` and `relate` take."""
        self._surroundings, self._learned_trust = surroundings, learned_trust
        self._features: WeakKeyDictionary[View, LocalFeatures] = WeakKeyDictionary()
        self._pairs: WeakKeyDictionary[View, WeakKeyDictionary[View, TwoViewGeometry]] = WeakKeyDictionary()

    def features(self, view: View) -> LocalFeatures:
        """Of a view whose geometries were asked for."""
        return self._features[view]

    def geometries(
        self, views: Sequence[View], learned: Mapping[View, DescriptorMap] | None = None
    ) -> dict[tuple[int, int], TwoViewGeometry]:
        """Of every pair of views i < j, by their positions; what is new on as many threads as torch has.

        Args:
            views: of one object.
            learned: what a network says of them, of each or of none; not without ``learned_trust``.
        """
        pairs = list(itertools.combinations(range(len(views)), 2))
        known = {(i, j): self._pairs.setdefault(views[i], WeakKeyDictionary()) for i, j in pairs}
        new = [(i, j) for i, j in pairs if views[j] not in known[i, j]]
        asked = dict.fromkeys(views[view] for pair in new for view in pair)  # each once, in order
        unseen = [view for view in asked if view not in self._features]
        maps, trusted = learned or {}, self._learned_trust
        looked = side_by_side(
            lambda view: find_features(view, maps.get(view), surroundings=self._surroundings), unseen
        )
        self._features.update(zip(unseen, looked, strict=True))
        found = side_by_side(
            lambda pair: relate(*(self._features[views[view]] for view in pair), learned_trust=trusted), new
        )
        for (i, j), geometry in zip(new, found, strict=True):
            known[i, j][views[j]] = geometry
        return {(i, j): known[i, j][views[j]] for i, j in pairs}


def peaks(geometry: TwoViewGeometry) -> list[Peak]:
    """What a pair's matches say of its rotation; nothing where they are more likely wrong than right.

    The solver looks for the highest density, and a sharp peak is high however improbable it is: two that are
    wrong, where cameras are free to suit both, would win over one that is right.
    """
    # Points that lie too close together suit so many poses that few of them are told.
    told = sum(pose.weight for pose in geometry.poses)
    if min(geometry.probability, told) < LEAST_PROBABILITY:
        return []
    found = []
    for pose in geometry.poses:
        chance = geometry.probability * pose.weight
        exact = WIDENING * pose.covariance + MATCHING_FLOOR**2 * np.eye(3)
        near = exact + NEAR_MISS**2 * np.eye(3)
        found.append(Peak(pose.rotation, exact, (1 - NEAR_MISSES) * chance))
        found.append(Peak(pose.rotation, near, NEAR_MISSES * chance))
    return found
