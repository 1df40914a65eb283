"""What matched local features say of two views' relative pose, and how far to trust it.

The five-point method (Nister 2004) in MAGSAC++ (Barath et al. 2020) finds a pose, `epipolar` its rivals.

Features are found once per view, and a pair's geometry once per pair. Rotations and translations are optical
column-vector ``camera_j_from_camera_i``.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import homogeneous
from relpose_ros.inference import epipolar
from relpose_ros.inference.epipolar import Poses
from relpose_ros.inference.local_features import extent, find_features, match
from relpose_ros.inference.outlines import sighted_translations
from relpose_ros.inference.rotation_evidence import Peak
from relpose_ros.inference.side_by_side import side_by_side
from relpose_ros.inference.uncertainty import BASIN

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from relpose_ros.inference.local_features import LocalFeatures
    from relpose_ros.inference.outlines import Outline
    from relpose_ros.views import View

    FloatArray = npt.NDArray[np.float64]
    IntArray = npt.NDArray[np.int64]

THRESHOLD = 1.5
"""Of an inlier, in pixels of the picture in which the features were found."""
REACH = 4.0
"""Pixels: matches that may obey a rival of the pose that was found, if not that one."""
SHAKE = 16.0
"""Pixels by which a camera that is meant to stand still may move its picture from one view to another."""
SHAKEN_SHARE = 0.8
"""Of a pose's inliers that one shift of the picture explains: from here on the camera is taken to have moved
in its place. Around an object that it moves about, near and far parts shift differently."""
LEAST_MATCHES = 16
"""Fewer are not trusted (see `trust`), whatever they say."""
TURN = math.radians(30)
"""How far features may turn from one picture to the other beside the way that most turn, rad: a surface at
a slant of 60 degrees turns gradients by up to 20, those of accidental matches turn anyhow."""
ITERATIONS = 1000
"""Of the robust estimator at most."""
GUESSED_FOCAL_DEVIATION = 0.2
"""Relative standard deviation of a guessed focal length. A rotation seen through a wrong one is wrong in
proportion."""
PLANAR_SHARE = 0.8
"""Of the matches, explained by one homography: from here on the points may lie on a plane, which two poses
explain equally well, or the camera may only have turned."""
TRUST = (-7.98, 2.31, -3.15, 2.54)
"""Coefficients of `trust`: the bias, and those of `Support.signs`."""
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
SEPARATION = math.radians(5)
"""Hypotheses nearer than this are one, rad."""
TEMPER = 5.0
"""Divisor of an explanation's cost: errors of features near each other go together, and of two explanations
the better one is often the wrong one by a hair. Fitted: the right one's likelihood is highest with it."""
LEAST_POSE_WEIGHT = 0.03
"""Of an explanation that is worth telling, relative to the best."""
MOST_EXPLANATIONS = 4
"""More say hardly anything, and each costs the solver time."""
DISTANCE_DEVIATION = 0.2
"""Relative standard deviation of the ratio of two cameras' distances from the object, by its boxes' sizes."""
WIDEST_DIRECTION = math.radians(60)
"""Standard deviation of a direction of which nothing is known, rad."""
LOOK_AT_FREEDOM = 3.0
"""Degrees of freedom of Student's t: boxes may be cut off, or the middle of another part of the object."""


@dataclass(frozen=True, eq=False)
class RelativePose:
    """One explanation of a pair's matches."""

    rotation: FloatArray
    """(3, 3) camera_j_from_camera_i."""
    direction: FloatArray
    """(3,) unit translation of camera_j_from_camera_i."""
    covariance: FloatArray
    """(3, 3) of the rotation vector, left perturbation, axes of camera j, rad^2."""
    direction_covariance: FloatArray
    """(3, 3) of ``direction``, tangential to it."""
    weight: float
    """Relative to the pair's other explanations; they sum to one, less what is not worth telling."""


@dataclass(frozen=True)
class Support:
    """What tells poses that are right from those that accidental matches happen to obey."""

    inliers: int
    """Matches that the best pose explains."""
    residual: float
    """Their mean distance from epipolar lines, pixels: accidental ones lie anywhere up to `THRESHOLD`."""
    spread: float
    """Of the inliers across their longest extent, relative to all features, in the view where it is less."""

    @property
    def signs(self) -> FloatArray:
        """(3,) logarithms, as the logistic regression takes them; residual and spread may be zero."""
        return np.log([self.inliers, self.residual + 0.05, self.spread + 0.02])


@dataclass(frozen=True, eq=False)
class Explanation:
    """The poses that explain the matches of two views."""

    poses: tuple[RelativePose, ...]
    """Best first."""
    inliers: IntArray
    """(M, 2) positions of matched features of view i and of view j that the first pose explains."""
    support: Support


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


def relate(first: LocalFeatures, second: LocalFeatures) -> TwoViewGeometry:
    """The relative pose of two views by their matches, and how far it is to be trusted."""
    found = explain(first, second)
    return NOTHING if found is None else TwoViewGeometry(found.poses, found.inliers, trust(found.support))


def explain(first: LocalFeatures, second: LocalFeatures) -> Explanation | None:
    """The poses that explain the matches of two views.

    None where there are too few matches, or too few that any pose explains.
    """
    matches = match(first, second)
    if not (first.strays and second.strays):
        found = _explained(first, second, matches)
        return None if found is None else found[0]
    # Before a camera that stands still an object that turns moves, and what is around it does not; nor does a
    # gripper before a camera in the hand. What stays where it was tells little in any other case.
    shifts = second.rays[matches[:, 1]] - first.rays[matches[:, 0]]
    shifts /= math.sqrt(first.pixel * second.pixel)
    moves = np.linalg.norm(shifts, axis=1) > THRESHOLD
    matches, shifts = matches[moves], shifts[moves]
    found = _explained(first, second, matches)
    if found is None:
        return None
    # A camera that shakes shifts all that stays by as much.
    common = np.median(shifts[found[1]], axis=0)
    shaken = np.linalg.norm(shifts - common, axis=1) < 2 * THRESHOLD
    if np.linalg.norm(common) < SHAKE and shaken[found[1]].mean() > SHAKEN_SHARE:
        found = _explained(first, second, matches[~shaken])
    return None if found is None else found[0]


def _explained(
    first: LocalFeatures, second: LocalFeatures, matches: IntArray
) -> tuple[Explanation, IntArray] | None:
    """The poses that explain some matches, and the positions of those that obey the best."""
    if len(matches) < LEAST_MATCHES:
        return None
    # Of one object seen twice they do (weak geometric consistency: Jegou et al. 2008).
    alike = _alike(second.orientations[matches[:, 1]] - first.orientations[matches[:, 0]])
    if alike.sum() < LEAST_MATCHES:
        return None
    positions, matches = np.flatnonzero(alike), matches[alike]
    rays_i, rays_j = homogeneous(first.rays[matches[:, 0]]), homogeneous(second.rays[matches[:, 1]])
    pixel = math.sqrt(first.pixel * second.pixel)
    found = _five_points(rays_i, rays_j, pixel)
    if found is None:
        return None
    near = np.abs(epipolar.distances(found, rays_i, rays_j)[0]) < REACH * pixel
    if near.sum() < LEAST_MATCHES:
        return None
    near_i, near_j = rays_i[near], rays_j[near]
    starts = found + epipolar.turned_along(found, near_i, near_j, pixel) + _of_plane(near_i, near_j, pixel)
    poses = epipolar.facing(epipolar.refine(starts, near_i, near_j, pixel), near_i, near_j)
    log_likelihoods = -epipolar.costs(poses, rays_i, rays_j, pixel) / TEMPER
    poses, weights = _distinct(poses, log_likelihoods + _look_at(poses, first.outline, second.outline))
    distances = np.abs(epipolar.distances(poses[:1], rays_i, rays_j)[0])
    inside = (distances < THRESHOLD * pixel) & epipolar.in_front(poses[:1], rays_i, rays_j)[0]
    if inside.sum() < LEAST_MATCHES:
        return None
    inliers = matches[inside]
    stated = _with_covariances(poses, weights, near_i, near_j, pixel)
    if first.guessed or second.guessed:
        stated = tuple(_widened(pose) for pose in stated)
    spread = min(
        extent(features.rays[inliers[:, view]]) / max(features.extent, 1e-12)
        for view, features in enumerate((first, second))
    )
    explanation = Explanation(
        stated,
        np.stack([first.places[inliers[:, 0]], second.places[inliers[:, 1]]], 1),
        Support(len(inliers), float(distances[inside].mean()) / pixel, spread),
    )
    return explanation, positions[inside]


def trust(support: Support) -> float:
    """Probability that one of a pair's poses is right, learned from pairs whose pose is known.

    Logistic, fitted by `benchmarks/match_trust.py` on the photographs that the shipped network was trained on
    (ascott_hound, buddha, socketed_axe) and on eight rendered captures of held-out objects, by boxes alone:
    photographs know few of the plain and repetitive surfaces that accidental matches come from.
    """
    bias, *slopes = TRUST
    return LARGEST_TRUST / (1 + math.exp(-(bias + float(support.signs @ slopes))))


def _alike(turns: FloatArray) -> npt.NDArray[np.bool_]:
    """Which of some angles are among the most that lie within `TURN` of one. (M,) rad -> (M,)."""
    angles = turns % math.tau
    around = np.sort(angles)
    last = np.searchsorted(np.concatenate([around, around + math.tau]), around + 2 * TURN, side="right")
    first = around[(last - np.arange(len(around))).argmax()]
    return np.asarray((angles - first) % math.tau <= 2 * TURN)


def _five_points(rays_i: FloatArray, rays_j: FloatArray, pixel: float) -> Poses | None:
    """A pose that many matches obey."""
    import cv2

    settings = cv2.UsacParams()
    settings.score = cv2.SCORE_METHOD_MAGSAC
    settings.loMethod = cv2.LOCAL_OPTIM_SIGMA
    settings.final_polisher = cv2.MAGSAC
    settings.loIterations, settings.loSampleSize, settings.final_polisher_iterations = 10, 20, 5
    settings.maxIterations, settings.confidence, settings.threshold = ITERATIONS, 0.999, THRESHOLD
    settings.randomGeneratorState = 1  # the same answer each time
    # In pixels of the picture: thresholds in other units have been misread by some versions.
    points_i, points_j = rays_i[:, :2] / pixel, rays_j[:, :2] / pixel
    camera = np.diag([1 / pixel, 1 / pixel, 1.0])
    try:
        essential, inside = cv2.findEssentialMat(points_i, points_j, camera, camera, None, None, settings)
    except cv2.error:  # too few different points
        return None
    if essential is None or essential.shape != (3, 3) or (inside > 0).sum() < LEAST_MATCHES:
        return None
    first, second, direction = cv2.decomposeEssentialMat(essential)
    rotations = np.stack([first, second]).astype(np.float64)
    towards = np.asarray(direction[:, 0], np.float64)
    poses = Poses(np.repeat(rotations, 2, 0), np.stack([towards, -towards] * 2))
    kept = inside[:, 0] > 0
    ahead = epipolar.in_front(poses, rays_i[kept], rays_j[kept]).sum(1)
    return poses[ahead.argmax()[None]]


def _of_plane(rays_i: FloatArray, rays_j: FloatArray, pixel: float) -> Poses:
    """The poses that a plane allows, where one holds most points; otherwise none."""
    import cv2

    points_i, points_j = rays_i[:, :2] / pixel, rays_j[:, :2] / pixel
    homography, inside = cv2.findHomography(points_i, points_j, cv2.RANSAC, 2 * THRESHOLD, maxIters=500)
    if homography is None or inside.mean() < PLANAR_SHARE:
        return Poses(np.zeros((0, 3, 3)), np.zeros((0, 3)))
    camera = np.diag([1 / pixel, 1 / pixel, 1.0])
    _, rotations, translations, _ = cv2.decomposeHomographyMat(homography, camera)
    directions = np.stack(translations)[:, :, 0]
    lengths = np.linalg.norm(directions, axis=1)
    poses = Poses(np.stack(rotations), directions / np.maximum(lengths, 1e-12)[:, None])
    # Of points that all but coincide it gives matrices that are no rotations.
    square = poses.rotations @ poses.rotations.transpose(0, 2, 1)
    sound = np.isfinite(poses.rotations).all((1, 2)) & (np.abs(square - np.eye(3)).max((1, 2)) < 1e-6)
    sound &= lengths > 1e-6
    return poses[sound][np.linalg.det(poses.rotations[sound]) > 0]


def _look_at(poses: Poses, first: Outline | None, second: Outline | None) -> FloatArray:
    """Log densities of the poses' directions, if both cameras see the object where its box is. -> (S,).

    The rotation then says where the second camera is (`sighted_translations`). That is one number more than
    matches have which leave the angle between the views open.
    """
    if first is None or second is None:
        return np.zeros(len(poses))
    ends = sighted_translations([first, second])
    chord = ends[1] - poses.rotations @ ends[0]
    length = np.linalg.norm(chord, axis=1)
    misfit = np.linalg.norm(np.cross(chord, poses.directions), axis=1)
    angle = np.arctan2(misfit, (chord * poses.directions).sum(1))
    relative = length / math.sqrt(float(np.linalg.norm(ends[1])))
    deviation = np.minimum(DISTANCE_DEVIATION / np.maximum(relative, 1e-9), WIDEST_DIRECTION)
    tails = (LOOK_AT_FREEDOM + 1) / 2 * np.log1p((angle / deviation) ** 2 / LOOK_AT_FREEDOM)
    return np.asarray(np.log(WIDEST_DIRECTION / deviation) - tails)


def _distinct(poses: Poses, heights: FloatArray) -> tuple[Poses, FloatArray]:
    """Poses that differ, best first, weighted (S,) by their log probabilities."""
    posterior = np.exp(heights - heights.max())
    kept: list[int] = []
    for k in np.argsort(-heights, kind="stable").tolist():
        apart = so3.angle_between(poses.rotations[kept], poses.rotations[k])
        if posterior[k] > LEAST_POSE_WEIGHT and (apart > SEPARATION).all():
            kept.append(k)
    weights = posterior[kept] / posterior[kept].sum()
    return poses[np.array(kept[:MOST_EXPLANATIONS])], weights[:MOST_EXPLANATIONS]


def _with_covariances(
    poses: Poses, weights: FloatArray, rays_i: FloatArray, rays_j: FloatArray, pixel: float
) -> tuple[RelativePose, ...]:
    """With the covariance of the least squares.

    Residuals count at their own scale, but not below a third of a pixel, which no feature is more exact than.
    """
    residuals, jacobian, across = epipolar.linearised(poses, rays_i, rays_j)
    scale = np.maximum(1.4826 * np.median(np.abs(residuals), 1), pixel / 3)
    robust = jacobian / (1 + (residuals / pixel) ** 2)[..., None]
    normal = robust.transpose(0, 2, 1) @ jacobian
    # Without parallax nothing is known of the direction: it stays within the sphere, and the rotation's
    # own uncertainty is what is left of it.
    prior = np.diag([1e-6, 1e-6, 1e-6, 1.0, 1.0])
    covariances = np.linalg.inv(normal / scale[:, None, None] ** 2 + prior)
    of_directions = across.transpose(0, 2, 1) @ covariances[:, 3:, 3:] @ across
    return tuple(
        RelativePose(rotation, direction, covariance[:3, :3], of_direction, float(weight))
        for rotation, direction, covariance, of_direction, weight in zip(
            poses.rotations, poses.directions, covariances, of_directions, weights, strict=True
        )
    )


def guessed_focal_covariance(turn: FloatArray) -> FloatArray:
    """What a guessed focal length adds to the covariance of a rotation: an error in proportion to the angle.

    Args:
        turn: (3,) the rotation vector.

    Returns:
        (3, 3) rad^2.
    """
    return GUESSED_FOCAL_DEVIATION**2 * (np.outer(turn, turn) + float(turn @ turn) * np.eye(3) / 4)


def _widened(pose: RelativePose) -> RelativePose:
    """With what a guessed focal length adds."""
    along = guessed_focal_covariance(so3.log(pose.rotation))
    spread = GUESSED_FOCAL_DEVIATION**2 * (np.eye(3) - np.outer(pose.direction, pose.direction)) / 4
    return replace(
        pose,
        covariance=pose.covariance + along,
        direction_covariance=pose.direction_covariance + spread,
    )


class Matcher:
    """Finds the features of a view and the geometry of a pair once, for as long as the views are held."""

    def __init__(self, *, surroundings: bool = False) -> None:
        """Takes what `find_features` takes."""
        self._surroundings = surroundings
        self._features: WeakKeyDictionary[View, LocalFeatures] = WeakKeyDictionary()
        self._pairs: WeakKeyDictionary[View, WeakKeyDictionary[View, TwoViewGeometry]] = WeakKeyDictionary()

    def features(self, view: View) -> LocalFeatures:
        """Of one view."""
        if view not in self._features:
            self._features[view] = find_features(view, surroundings=self._surroundings)
        return self._features[view]

    def geometries(self, views: Sequence[View]) -> dict[tuple[int, int], TwoViewGeometry]:
        """Of every pair of views i < j, by their positions; what is new on as many threads as torch has."""
        pairs = list(itertools.combinations(range(len(views)), 2))
        known = {(i, j): self._pairs.setdefault(views[i], WeakKeyDictionary()) for i, j in pairs}
        new = [(i, j) for i, j in pairs if views[j] not in known[i, j]]
        unseen = dict.fromkeys(views[view] for pair in new for view in pair)  # each once, in order
        features = dict(zip(unseen, side_by_side(self.features, unseen), strict=True))
        found = side_by_side(lambda pair: relate(*(features[views[view]] for view in pair)), new)
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
