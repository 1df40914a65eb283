"""The poses that explain the matches of two views.

The five-point method (Nister 2004) in MAGSAC++ (Barath et al. 2020) finds a pose, `epipolar` its rivals.
Rotations and translations are optical column-vector ``camera_j_from_camera_i``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import homogeneous
from relpose_ros.inference import epipolar
from relpose_ros.inference.epipolar import Poses
from relpose_ros.inference.local_features import extent, match
from relpose_ros.inference.outlines import GUESSED_FOCAL_DEVIATION, sighted_translations
from relpose_ros.inference.turns_in_place import commonest_turn, directions_of, follows

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.inference.local_features import LocalFeatures
    from relpose_ros.inference.outlines import Outline

    FloatArray = npt.NDArray[np.float64]
    IntArray = npt.NDArray[np.int64]

THRESHOLD = 1.5
"""Of an inlier, in pixels of the picture in which the features were found."""
REACH = 4.0
"""Pixels: matches that may obey a rival of the pose that was found, if not that one."""
WALL = 8
"""Matches that stay where they are, from which on something is taken to stand still around the object. Of
1100 pairs of photographs and renderings without such a thing none had more than five."""
SHAKE = 64.0
"""By which a camera that is meant to stand still may shift the picture that features are found in, pixels."""
SHAKEN_SHARE = 0.8
"""Of a pose's inliers that one turn of the camera explains: from here on it is taken to have turned in its
place. Around an object that it moves about, near and far parts shift differently."""
SUSPECT_SHARE = 0.3
"""The same, from which on the other matches are asked alone: a wall and an object that turns before it may
both suit one pose, that of the wall."""
LEAST_MATCHES = 16
"""Fewer are not trusted (see `trust`), whatever they say."""
TURN = math.radians(30)
"""How far features may turn from one picture to the other beside the way that most turn, rad: a surface at
a slant of 60 degrees turns gradients by up to 20, those of accidental matches turn anyhow."""
ITERATIONS = 1000
"""Of the robust estimator at most."""
PLANAR_SHARE = 0.8
"""Of the matches, explained by one homography: from here on the points may lie on a plane, which two poses
explain equally well, or the camera may only have turned."""
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
    learned: bool = False
    """Whether a network's descriptors helped to match."""

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
    """(M, 2) features of view i and of view j that match and obey the first pose."""
    support: Support


def explain(first: LocalFeatures, second: LocalFeatures) -> Explanation | None:
    """The poses that explain the matches of two views.

    None where there are too few matches, or too few that any pose explains. Where something may stand still
    around the object SIFT is asked alone: a network that was taught objects takes one brick for the next.
    """
    matches = match(first, second)
    if not (first.strays and second.strays):
        return _explained(first, second, matches)
    # Before a camera that stands still an object that turns moves, and what is around it does not; nor does a
    # gripper before a camera in the hand. What stays where it was tells little in any other case.
    pixel = math.sqrt(first.pixel * second.pixel)
    shifts = np.linalg.norm(second.rays[matches[:, 1]] - first.rays[matches[:, 0]], axis=1) / pixel
    moves = shifts > THRESHOLD
    if first.learned and np.count_nonzero(~moves) >= WALL:
        return explain(first.by_sift, second.by_sift)
    matches, shifts = matches[moves], shifts[moves]
    found = _explained(first, second, matches)
    if found is None:
        return None
    # A camera that shakes turns all that stays as one.
    reach = 2 * THRESHOLD * pixel
    directions = directions_of(first, second, matches)
    turn = commonest_turn(directions, reach)
    stays = follows(turn, directions, reach)
    if stays.sum() < LEAST_MATCHES:
        return found
    share = follows(turn, directions_of(first, second, found.inliers), reach).mean()
    if first.learned:
        # A pose that has no more than that turn's rotation is a wall's, or of a camera that hardly moved.
        turned = so3.angle_between(found.poses[0].rotation, turn) > SEPARATION
        return found if turned and share < SUSPECT_SHARE else explain(first.by_sift, second.by_sift)
    if share < SUSPECT_SHARE or np.median(shifts[stays]) > SHAKE:
        return found
    rest = _explained(first, second, matches[~stays])
    if share > SHAKEN_SHARE:
        return rest
    another = (
        rest is not None
        and so3.angle_between(rest.poses[0].rotation, found.poses[0].rotation) > SEPARATION
        and len(rest.inliers) > (~stays).sum() / 2
    )
    return rest if another else found


def _explained(first: LocalFeatures, second: LocalFeatures, matches: IntArray) -> Explanation | None:
    """The poses that explain some of the matches."""
    if len(matches) < LEAST_MATCHES:
        return None
    # Of one object seen twice they do (weak geometric consistency: Jegou et al. 2008).
    matches = matches[_alike(second.orientations[matches[:, 1]] - first.orientations[matches[:, 0]])]
    if len(matches) < LEAST_MATCHES:
        return None
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
    return Explanation(
        *(stated, inliers),
        Support(len(inliers), float(distances[inside].mean()) / pixel, spread, first.learned),
    )


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
    """What a guessed focal length adds to the covariance of a rotation, which it makes wrong in proportion.

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
