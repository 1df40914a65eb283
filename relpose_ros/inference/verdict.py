"""Whether a scan is enough to act on, in a number for a planner and in words for a person."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.estimates import Evidence, Verdict
from relpose_ros.inference.outlines import AHEAD

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from relpose_ros.estimates import PairRotation

TRUSTED_PROBABILITY = 0.6
"""A pair is trusted when this much of its probability lies within 15 degrees of the final poses: more likely
right than wrong with a margin, and impossible for a pair with two equal modes. A chain of pairs is trusted
when the product of theirs is as much."""
HARDLY_ANYTHING = 2
"""Percent within 15 degrees below which a number would claim more than is known; uniform has 0.1."""
CONTRADICTION_ANGLE = math.radians(10)
"""From this angle on between a pair's own rotation and the final poses' the two disagree."""
CONTRADICTED = 0.1
"""Probability of the final poses, to 15 degrees, below which a pair that is sure of itself contradicts."""
MOST_CONTRADICTING = 1 / 6
"""Such pairs for each one that is trusted. A few are outvoted; of a repetitive surface, which matches take in
several ways, every third was seen, with poses up to 50 degrees off."""
LARGEST_ROTATION_DEVIATION = math.radians(7.5)
"""Largest standard deviation (worst axis) of a camera's rotation: 15 degrees are two of them."""
SAME_PLACE = math.radians(3)
"""Two views of a trusted pair whose lines of sight differ by less are one: a picture taken twice repeats its
mistakes."""
ONE_MORE = "one more view: "
NOT_ENOUGH = "not enough: "
WITHOUT_ROOM = {
    "first": "the scan is full: drop_last_view makes room for another view, reset for all",
    "latest": "take one more view: it takes the place of the oldest",
    "spread": "drop_last_view makes room for a view near that pair, and one from a new direction takes the "
    "place of the view that tells least",
}
"""What to do where no more views are held, by the scan's policy of which ones stay."""

GUESSED = (
    "the camera's focal length is a guess, and with a wrong one all turns are wrong in proportion: send the "
    "intrinsics, in camera_info or as k"
)
"""What is missing where no view said how it was taken, in words."""

UNCALIBRATED = "these weights are not calibrated, so that none of their estimates can be called enough"
"""What is missing where nobody knows how far probabilities hold, in words."""

WITHOUT_PROBABILITIES = (
    f"{NOT_ENOUGH}this network regresses poses and cannot say how far to trust them, so that none of its "
    "estimates can be called enough"
)
"""The verdict on poses that come without a distribution, in words."""


def judge(
    pairs: Sequence[PairRotation],
    covariances: npt.NDArray[np.float64],
    calibrated: bool,
    *,
    guessed: bool = False,
    seen: npt.NDArray[np.float64] | None = None,
) -> tuple[Verdict, int, str]:
    """The verdict, the weakest pair's position and the verdict in words.

    ENOUGH asks for six things: a trusted chain of pairs from every camera to the first; that no camera and
    no group of them hangs on a single pair, which nothing checks, so that two views are never enough, however
    often each was taken; that hardly any pair which is as sure contradicts them; a small covariance of every
    camera's rotation; calibrated probabilities, without which the others mean nothing; and a known focal
    length where matches are among what it rests on, since with a wrong one all turns are wrong together, by a
    fifth of them or more. Of positions it asks nothing: their covariances say what is known. Views are named
    by their position in the scan, from 0, as in the messages.

    Args:
        pairs: of all N views.
        covariances: (N, 6, 6) of the cameras.
        calibrated: whether the probabilities were calibrated.
        guessed: whether a view's focal length is a guess.
        seen: (N, 3) unit vectors towards the object in the cameras' axes; None for straight ahead. A camera
            that only pans or rolls has not left its place.
    """
    deviations = rotation_deviations(covariances)
    worst = f"about {math.degrees(deviations.max()):.0f} degrees"
    seen = np.tile(AHEAD, (len(covariances), 1)) if seen is None else seen
    trusted = [p for p, pair in enumerate(pairs) if pair.solution_probability >= TRUSTED_PROBABILITY]
    if loose := _loose(pairs, len(covariances)):
        weakest = _weak_link(pairs, loose, len(covariances))
        return Verdict.ONE_MORE_VIEW, weakest, f"{ONE_MORE}{_weakness(pairs[weakest])}"
    if (unchecked := _unchecked(pairs, trusted, seen)) is not None:
        bridge, views = unchecked
        hangs = f"view {views[0]} hangs" if len(views) == 1 else f"views {_listed(views)} hang"
        reason = f"{hangs} on {_name(pairs[bridge])} alone, which no other pair checks"
        return Verdict.ONE_MORE_VIEW, bridge, f"{ONE_MORE}{reason}"
    against = [p for p, pair in enumerate(pairs) if _contradicts(pair)]
    if len(against) > MOST_CONTRADICTING * len(trusted):
        surest = max(against, key=lambda p: pairs[p].probability_within_15_deg)
        agree = (
            f"{len(trusted)} of {len(pairs)} pairs agree, but {len(against)} are as sure of something else"
        )
        return Verdict.ONE_MORE_VIEW, surest, f"{ONE_MORE}{agree}: {_weakness(pairs[surest])}"
    if deviations.max() > LARGEST_ROTATION_DEVIATION:
        weakest = _weak_link(pairs, [int(deviations.argmax())], len(covariances))
        reason = f"rotations are known to {worst} only, the weak link is {_name(pairs[weakest])}"
        return Verdict.ONE_MORE_VIEW, weakest, f"{ONE_MORE}{reason}"
    weakest = min(range(len(pairs)), key=lambda p: _certainty(pairs[p]))
    if guessed and any(Evidence.GEOMETRIC in pairs[p].evidence for p in trusted):
        return Verdict.ONE_MORE_VIEW, weakest, f"{NOT_ENOUGH}{GUESSED}"
    if not calibrated:
        return Verdict.ONE_MORE_VIEW, weakest, f"{NOT_ENOUGH}{UNCALIBRATED}"
    agree = f"{len(trusted)} of {len(pairs)} pairs agree, rotations to {worst}"
    return Verdict.ENOUGH, weakest, f"enough: {agree}"


def rotation_deviations(covariances: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Standard deviation of each camera's rotation about its worst axis, rad. (..., 6, 6) -> (...)."""
    return np.asarray(np.sqrt(np.linalg.eigvalsh(covariances[..., 3:, 3:])[..., -1]))


def without_room(words: str, keep: str) -> str:
    """A verdict in words where the scan holds as many views as it may.

    Args:
        words: As `judge` says them.
        keep: Which views stay: a key of ``WITHOUT_ROOM``.
    """
    reason = words.removeprefix(ONE_MORE)
    return words if reason == words else f"{NOT_ENOUGH}{reason}; {WITHOUT_ROOM[keep]}"


def _certainty(pair: PairRotation) -> float:
    return min(pair.probability_within_15_deg, pair.solution_probability)


def _contradicts(pair: PairRotation) -> bool:
    """Whether a pair is sure of a rotation which is not that of the final poses."""
    sure = pair.probability_within_15_deg >= TRUSTED_PROBABILITY
    return sure and pair.solution_probability < CONTRADICTED


def _name(pair: PairRotation) -> str:
    return f"pair {pair.i}-{pair.j}"


def _weakness(pair: PairRotation) -> str:
    name = _name(pair)
    if pair.ambiguous:
        return f"{name} is ambiguous by about {10 * round(math.degrees(pair.ambiguity_angle) / 10)} degrees"
    if pair.probability_within_15_deg >= TRUSTED_PROBABILITY and pair.solution_angle < CONTRADICTION_ANGLE:
        return f"the chain of pairs is long, and {name} is its weak link"
    if pair.probability_within_15_deg >= TRUSTED_PROBABILITY:
        return f"{name} contradicts the others by about {math.degrees(pair.solution_angle):.0f} degrees"
    chance = 100 * pair.probability_within_15_deg
    if chance < HARDLY_ANYTHING:
        return f"{name} says hardly anything of its rotation"
    return f"{name} knows its rotation to 15 degrees with {chance:.0f}% only"


def _weak_link(pairs: Sequence[PairRotation], cameras: Sequence[int], views: int) -> int:
    """The pair that keeps cameras from being known.

    Not the one that knows least, which may be of two views that show opposite sides: the weak link of the
    best chain is what a further view between the two would mend.
    """
    chains = _chains(pairs, views)
    blocking = [p for camera in cameras for p in chains[camera]] or list(range(len(pairs)))
    return min(blocking, key=lambda p: _certainty(pairs[p]))


def _chains(pairs: Sequence[PairRotation], views: int) -> list[list[int]]:
    """For each camera the pairs that tie it to the first along a maximum spanning tree of their certainty."""
    chains: list[list[int] | None] = [[], *[None] * (views - 1)]
    for _ in range(views - 1):
        ends = [p for p, pair in enumerate(pairs) if (chains[pair.i] is None) != (chains[pair.j] is None)]
        best = max(ends, key=lambda p: _certainty(pairs[p]))
        i, j = pairs[best].i, pairs[best].j
        old, new = (i, j) if chains[j] is None else (j, i)
        chains[new] = [*(chains[old] or []), best]
    return [chain or [] for chain in chains]


def _unchecked(
    pairs: Sequence[PairRotation], trusted: Sequence[int], seen: npt.NDArray[np.float64]
) -> tuple[int, list[int]] | None:
    """A trusted pair without which the trusted ones tie not all views together, and the views of its far end.

    Pairs between the same two places are one. The least certain of such pairs. Its far end is the smaller
    one; of two as large, the one without view 0.
    """
    repeated = [pairs[p] for p in trusted if _around_the_object(pairs[p], seen) < SAME_PLACE]
    places = [frozenset(min(_reached(view, repeated)) for view in (pairs[p].i, pairs[p].j)) for p in trusted]
    found = []
    for bridge, ends in zip(trusted, places, strict=True):
        others = [pairs[p] for p, between in zip(trusted, places, strict=True) if between != ends]
        near = _reached(pairs[bridge].i, others)
        if pairs[bridge].j not in near:
            far = _reached(pairs[bridge].j, others)
            views = min(near, far, key=lambda each: (len(each), 0 in each))
            found.append((_certainty(pairs[bridge]), bridge, sorted(views)))
    return min(found)[1:] if found else None


def _around_the_object(pair: PairRotation, seen: npt.NDArray[np.float64]) -> float:
    """Angle between the two cameras' lines of sight to the object, rad."""
    cosine = seen[pair.i] @ pair.camera_j_from_camera_i.T @ seen[pair.j]
    return float(np.arccos(np.clip(cosine, -1, 1)))


def _reached(view: int, pairs: Sequence[PairRotation]) -> set[int]:
    """The views that pairs tie to one of them, with itself."""
    reached, known = {view}, 0
    while len(reached) > known:
        known = len(reached)
        for pair in pairs:
            if pair.i in reached or pair.j in reached:
                reached |= {pair.i, pair.j}
    return reached


def _listed(views: Sequence[int]) -> str:
    return f"{', '.join(map(str, views[:-1]))} and {views[-1]}"


def _loose(pairs: Sequence[PairRotation], views: int) -> list[int]:
    """Cameras that no chain of pairs ties to the first whose probabilities multiply to what is trusted."""
    reached = [1.0, *[0.0] * (views - 1)]
    for _ in range(views - 1):
        for pair in pairs:
            reached[pair.i] = max(reached[pair.i], reached[pair.j] * pair.solution_probability)
            reached[pair.j] = max(reached[pair.j], reached[pair.i] * pair.solution_probability)
    return [camera for camera, chance in enumerate(reached) if chance < TRUSTED_PROBABILITY]
