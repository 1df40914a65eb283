"""What matched local features say of two views' relative pose, and how far to trust it.

SIFT (Lowe 2004), the five-point method (Nister 2004) in MAGSAC++ (Barath et al. 2020), then least squares.

Features are found once per view, and a pair's geometry once per pair. Rotations and translations are optical
column-vector ``camera_j_from_camera_i``. Image coordinates are rays (x / z, y / z) of the pinhole camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.inference.rotation_evidence import Peak
from relpose_ros.views import Intrinsics

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from relpose_ros.views import View

    FloatArray = npt.NDArray[np.float64]
    IntArray = npt.NDArray[np.int64]

MOST_FEATURES = 2500
LONGEST_SIDE = 800
"""Pixels: a larger part of an image is shrunk to it. Features of one more octave cost more than they add."""
LARGEST_SCALE = 2.0
"""A smaller part is enlarged, up to twice: SIFT finds little in a small crop as it is."""
CONTRAST = 0.01
"""A quarter of Lowe's: plain objects have few features of any contrast, and a bad one costs little."""
RATIO = 0.85
"""Largest distance of a match relative to the second best (Lowe 2004), on root-normalised descriptors."""
ROUNDING = 1e-5
"""Of a squared distance of descriptors."""
THRESHOLD = 1.5
"""Of an inlier, in pixels of the picture in which the features were found."""
LEAST_MATCHES = 8
GUESSED_FOCAL = 1.2
"""Focal length relative to the longer side where nobody tells it: between a phone's and a webcam's."""
GUESSED_FOCAL_DEVIATION = 0.2
"""Its relative standard deviation. A rotation seen through a wrong focal length is wrong in proportion."""
PLANAR_SHARE = 0.8
"""Of the inliers, explained by one homography: from here on the points may lie on a plane, which two poses
explain equally well, or the camera may only have turned."""
TRUST = (-10.4, 3.46, 1.12, -0.57)
"""Coefficients of `trust`: of the logarithms of the inliers and of their share, of a second explanation."""
WIDENING = 8.0
"""Factor on a matched rotation's covariance: errors of features near each other go together."""
FLOOR = math.radians(0.3)
"""Standard deviation, rad, of what no number of matches averages away: the intrinsics, above all."""
NEAR_MISSES = 0.15
"""Share of the poses, otherwise right, that shallow relief or few well-spread points leave further off."""
NEAR_MISS = math.radians(8)
"""How far, standard deviation in rad."""
AGREEMENT = math.radians(10)
"""Matches hold positions and points where their rotation and the cameras' agree to this, rad."""
TRUSTED = 0.5
"""Probability of a pair's poses from which on its matches count."""
SEPARATION = math.radians(5)
"""Hypotheses nearer than this are one, rad."""
ITERATIONS = 12


@dataclass(frozen=True, eq=False)
class LocalFeatures:
    """The local features of one view."""

    rays: FloatArray
    """(K, 2)."""
    descriptors: npt.NDArray[np.float32]
    """(K, 128), unit length, root-normalised (Arandjelovic and Zisserman 2012)."""
    pixel: float
    """A pixel of the picture in which they were found, in units of ``rays``: the scale of their accuracy."""
    guessed: bool
    """Whether the intrinsics are a guess."""


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
    """Relative to the pair's other explanations; they sum to one."""


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
        if self.probability < TRUSTED:
            return False
        return bool(so3.angle_between(rotation, self.poses[0].rotation) < AGREEMENT)


NOTHING = TwoViewGeometry((), np.zeros((0, 2), np.int64), 0.0)


def find_features(view: View, *, surroundings: bool = False) -> LocalFeatures:
    """SIFT features of the object, or of all the picture.

    Args:
        view: Its intrinsics are guessed from the size of the image where it has none.
        surroundings: Whether what lies outside the object's box and mask takes part. A static table helps a
            moving camera, and misleads where the object is what turns.
    """
    import cv2

    left, top, picture = _part(view, surroundings)
    scale = min(LARGEST_SCALE, LONGEST_SIDE / max(picture.shape[:2]))
    grey: Any = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    region: Any = None
    if view.mask is not None and not surroundings:
        rows, columns = slice(top, top + grey.shape[0]), slice(left, left + grey.shape[1])
        region = view.mask[rows, columns].astype(np.uint8)
    if scale != 1:
        size = (max(1, round(scale * grey.shape[1])), max(1, round(scale * grey.shape[0])))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        region = None if region is None else cv2.resize(region, size, interpolation=cv2.INTER_NEAREST)
    create: Any = vars(cv2)["SIFT_create"]  # in every version, and in no version's type stubs
    sift = create(nfeatures=MOST_FEATURES, contrastThreshold=CONTRAST)
    points, found = sift.detectAndCompute(grey, region)
    intrinsics, guessed = _intrinsics(view)
    descriptors = np.zeros((0, 128), np.float32) if found is None else found
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    # OpenCV's (0, 0) is the first pixel's centre.
    pixels = np.array([point.pt for point in points], np.float64).reshape(-1, 2) + 0.5
    # Sizes are whole: the sides may have been scaled a little differently.
    pixels *= [picture.shape[1] / grey.shape[1], picture.shape[0] / grey.shape[0]]
    pixels += [left + view.origin[0], top + view.origin[1]]
    focal = np.array([intrinsics.fx, intrinsics.fy])
    rays = (pixels - [intrinsics.cx, intrinsics.cy]) / focal
    return LocalFeatures(rays, descriptors, 1 / (scale * float(focal.mean())), guessed)


def match(first: LocalFeatures, second: LocalFeatures) -> IntArray:
    """Features that are each other's nearest, and much nearer than the second. -> (M, 2) positions."""
    if len(first.descriptors) < 2 or len(second.descriptors) < 2:
        return np.zeros((0, 2), np.int64)
    likeness = first.descriptors @ second.descriptors.T
    rows = np.arange(len(likeness))
    best = likeness.argmax(1)
    mutual = likeness.argmax(0)[best] == rows
    highest = likeness[rows, best]
    likeness[rows, best] = -1
    # Squared distances of unit vectors, to rounding: of two that look the same, none is the nearer.
    apart = 2 - 2 * highest + ROUNDING < RATIO**2 * (2 - 2 * likeness.max(1))
    chosen = rows[mutual & apart]
    return np.stack([chosen, best[chosen]], 1)


def relate(first: LocalFeatures, second: LocalFeatures) -> TwoViewGeometry:
    """The relative pose of two views by their matches (five-point method in MAGSAC++, then least squares)."""
    matches = match(first, second)
    if len(matches) < LEAST_MATCHES:
        return NOTHING
    rays_i, rays_j = first.rays[matches[:, 0]], second.rays[matches[:, 1]]
    pixel = math.sqrt(first.pixel * second.pixel)
    essential, inside = _five_points(rays_i, rays_j, pixel)
    if essential is None or inside.sum() < LEAST_MATCHES:
        return NOTHING
    kept_i, kept_j = rays_i[inside], rays_j[inside]
    starts = _decomposed(essential, kept_i, kept_j)
    planar, plane_starts = _plane(kept_i, kept_j, pixel)
    if planar:
        starts += plane_starts
    poses = _distinct([_refine(rotation, t, kept_i, kept_j, pixel) for rotation, t in starts], planar)
    if not poses:
        return NOTHING
    if first.guessed or second.guessed:
        poses = tuple(_widened(pose) for pose in poses)
    probability = trust(int(inside.sum()), len(matches), several=len(poses) > 1)
    return TwoViewGeometry(poses, matches[inside], probability)


def trust(inliers: int, matches: int, *, several: bool) -> float:
    """Probability that the pose of a pair is right, learned from pairs whose pose is known.

    Logistic in the logarithms of the inliers and of their share of the matches
    (`benchmarks/match_trust.py` fits it, here on the training captures).
    """
    bias, of_inliers, of_share, of_several = TRUST
    score = (
        bias + of_inliers * math.log(inliers) + of_share * math.log(inliers / matches) + of_several * several
    )
    return 0.995 / (1 + math.exp(-score))


def _part(view: View, surroundings: bool) -> tuple[int, int, npt.NDArray[np.uint8]]:
    """Column, row (in ``view.image``) and pixels of where to look."""
    height, width = view.image.shape[:2]
    if surroundings:
        return 0, 0, view.image
    x, y = view.origin
    left, top = (
        min(max(round(view.box.x0 - x), 0), width - 1),
        min(max(round(view.box.y0 - y), 0), height - 1),
    )
    # One pixel at least, which has no features, as a box outside the image has none.
    right, bottom = max(round(view.box.x1 - x), left + 1), max(round(view.box.y1 - y), top + 1)
    return left, top, view.image[top:bottom, left:right]


def _intrinsics(view: View) -> tuple[Intrinsics, bool]:
    if view.intrinsics is not None:
        return view.intrinsics, False
    focal = GUESSED_FOCAL * max(view.full_width, view.full_height)
    return Intrinsics(focal, focal, view.full_width / 2, view.full_height / 2), True


def _five_points(rays_i: FloatArray, rays_j: FloatArray, pixel: float) -> tuple[Any, npt.NDArray[np.bool_]]:
    """The essential matrix, or None, and which rays (M, 2) it explains, (M,) bool."""
    import cv2

    settings = cv2.UsacParams()
    settings.score = cv2.SCORE_METHOD_MAGSAC
    settings.loMethod = cv2.LOCAL_OPTIM_SIGMA
    settings.final_polisher = cv2.MAGSAC
    settings.loIterations, settings.loSampleSize, settings.final_polisher_iterations = 10, 20, 5
    settings.maxIterations, settings.confidence, settings.threshold = 2000, 0.9999, THRESHOLD
    settings.randomGeneratorState = 1  # the same answer each time
    # In pixels of the picture: thresholds in other units have been misread by some versions.
    camera = np.diag([1 / pixel, 1 / pixel, 1.0])
    try:
        essential, inside = cv2.findEssentialMat(
            rays_i / pixel, rays_j / pixel, camera, camera, None, None, settings
        )
    except cv2.error:  # too few different points
        return None, np.zeros(len(rays_i), bool)
    if essential is None or essential.shape != (3, 3):
        return None, np.zeros(len(rays_i), bool)
    return essential, inside[:, 0] > 0


def _decomposed(
    essential: FloatArray, rays_i: FloatArray, rays_j: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """The pose of an essential matrix that has most points in front of both cameras."""
    import cv2

    first, second, direction = cv2.decomposeEssentialMat(essential)
    rotations = np.asarray(first, np.float64), np.asarray(second, np.float64)
    towards = np.asarray(direction[:, 0], np.float64)
    poses = [(rotation, t) for rotation in rotations for t in (towards, -towards)]
    in_front = [_in_front(r, t, rays_i, rays_j).sum() for r, t in poses]
    return [poses[int(np.argmax(in_front))]]


def _plane(
    rays_i: FloatArray, rays_j: FloatArray, pixel: float
) -> tuple[bool, list[tuple[FloatArray, FloatArray]]]:
    """Whether one homography explains most points, and the poses it allows."""
    import cv2

    homography, inside = cv2.findHomography(
        rays_i / pixel, rays_j / pixel, cv2.RANSAC, 2 * THRESHOLD, maxIters=500
    )
    if homography is None or inside.mean() < PLANAR_SHARE:
        return False, []
    camera = np.diag([1 / pixel, 1 / pixel, 1.0])
    _, rotations, translations, normals = cv2.decomposeHomographyMat(homography, camera)
    inner = np.concatenate([rays_i, np.ones((len(rays_i), 1))], 1)[inside[:, 0] > 0]
    poses = []
    for rotation, translation, normal in zip(rotations, translations, normals, strict=True):
        length = float(np.linalg.norm(translation))
        visible = np.mean(inner @ normal[:, 0] > 0)
        if visible > 0.5 and length > 1e-6 and np.linalg.det(rotation) > 0:
            poses.append((np.asarray(rotation, np.float64), np.asarray(translation[:, 0] / length)))
    return True, poses


def _in_front(
    rotation: FloatArray, direction: FloatArray, rays_i: FloatArray, rays_j: FloatArray
) -> npt.NDArray[np.bool_]:
    """Which points lie in front of both cameras. (M, 2) twice -> (M,)."""
    depth_i, depth_j = _depths(rotation, direction, rays_i, rays_j)
    return (depth_i > 0) & (depth_j > 0)


def _depths(
    rotation: FloatArray, direction: FloatArray, rays_i: FloatArray, rays_j: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Depths in both cameras of the points nearest to both rays, in units of the baseline. -> (M,), (M,)."""
    a = _homogeneous(rays_i) @ rotation.T
    b = _homogeneous(rays_j)
    # depth_i a + direction = depth_j b, in the sense of least squares.
    aa, bb, ab = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
    at, bt = a @ direction, b @ direction
    determinant = np.maximum(aa * bb - ab * ab, 1e-15)
    return (ab * bt - bb * at) / determinant, (aa * bt - ab * at) / determinant


def _homogeneous(rays: FloatArray) -> FloatArray:
    return np.concatenate([rays, np.ones((len(rays), 1))], 1)


def _refine(
    rotation: FloatArray, direction: FloatArray, rays_i: FloatArray, rays_j: FloatArray, pixel: float
) -> tuple[RelativePose, float]:
    """Gauss-Newton on the Sampson distance, with Cauchy weights. -> the pose, of weight 1, and its cost.

    The covariance is that of the least squares, its residuals at their own scale but not below a third of a
    pixel, which no feature is more exact than.
    """
    here = _Epipolar(rotation, direction, rays_i, rays_j)
    residuals, jacobian = here.residuals()
    damping = 1e-3
    for _ in range(ITERATIONS):
        weights = 1 / (1 + (residuals / pixel) ** 2)
        normal = (jacobian * weights[:, None]).T @ jacobian
        step = -np.linalg.solve(
            normal + damping * np.diag(np.diag(normal) + 1e-9), jacobian.T @ (weights * residuals)
        )
        there = here.moved(step)
        new_residuals, new_jacobian = there.residuals()
        if _cauchy(new_residuals, pixel) < _cauchy(residuals, pixel):
            here, residuals, jacobian = there, new_residuals, new_jacobian
            damping = max(damping / 10, 1e-9)
            if np.linalg.norm(step) < 1e-7:
                break
        else:
            damping *= 10
    weights = 1 / (1 + (residuals / pixel) ** 2)
    scale = max(1.4826 * float(np.median(np.abs(residuals))), pixel / 3)
    normal = (jacobian * weights[:, None]).T @ jacobian
    # Without parallax nothing is known of the direction: it stays within the sphere, and the rotation's
    # own uncertainty is what is left of it.
    covariance = np.linalg.inv(normal / scale**2 + np.diag([1e-6, 1e-6, 1e-6, 1.0, 1.0]))
    basis = here.basis
    pose = RelativePose(
        here.rotation, here.direction, covariance[:3, :3], basis @ covariance[3:, 3:] @ basis.T, 1.0
    )
    return pose, _cauchy(residuals, pixel)


def _cauchy(residuals: FloatArray, scale: float) -> float:
    return float(np.log1p((residuals / scale) ** 2).sum())


class _Epipolar:
    """A relative pose and how far each pair of rays is from obeying it."""

    def __init__(
        self, rotation: FloatArray, direction: FloatArray, rays_i: FloatArray, rays_j: FloatArray
    ) -> None:
        self.rotation, self.direction = rotation, direction / np.linalg.norm(direction)
        self._rays = rays_i, rays_j
        # Two directions across the translation: it moves on the unit sphere.
        self.basis = np.linalg.svd(self.direction[None])[2][1:].T

    def residuals(self) -> tuple[FloatArray, FloatArray]:
        """Sampson distances (M,) and their derivatives (M, 5) by rotation and direction.

        The distance's denominator is taken as constant: it hardly changes where the distance is small.
        """
        x, y = (_homogeneous(rays) for rays in self._rays)
        turned = x @ self.rotation.T
        epipolar = np.cross(self.direction, turned)  # line in j, (M, 3)
        across = np.cross(y, self.direction)
        back = across @ self.rotation  # line in i
        length = np.sqrt((epipolar[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1) + 1e-15)
        by_rotation = np.cross(turned, across)
        by_direction = np.cross(turned, y) @ self.basis
        jacobian = np.concatenate([by_rotation, by_direction], 1) / length[:, None]
        return (y * epipolar).sum(1) / length, jacobian

    def moved(self, step: FloatArray) -> _Epipolar:
        """After a step (5,) of rotation (left perturbation) and direction."""
        rotation = so3.exp(step[:3]) @ self.rotation
        return _Epipolar(rotation, self.direction + self.basis @ step[3:], *self._rays)


def _distinct(found: list[tuple[RelativePose, float]], planar: bool) -> tuple[RelativePose, ...]:
    """Poses that differ, best first, weighted by how well each explains the points."""
    found = sorted(found, key=lambda each: each[1])
    kept: list[tuple[RelativePose, float]] = []
    for pose, cost in found:
        if all(so3.angle_between(pose.rotation, other.rotation) > SEPARATION for other, _ in kept):
            kept.append((pose, cost))
    # Of points on a plane the better explanation is often the wrong one by a hair: costs are tempered.
    temper = 4.0 if planar else 1.0
    weights = np.array([math.exp(max(-(cost - kept[0][1]) / temper, -30)) for _, cost in kept])
    weights = weights / weights.sum()
    return tuple(
        RelativePose(p.rotation, p.direction, p.covariance, p.direction_covariance, float(weight))
        for (p, _), weight in zip(kept, weights, strict=True)
    )


def _widened(pose: RelativePose) -> RelativePose:
    """With what a guessed focal length adds: an error in proportion to the angle turned."""
    turn = so3.log(pose.rotation)
    along = (GUESSED_FOCAL_DEVIATION / 2) ** 2 * (np.outer(turn, turn) + float(turn @ turn) * np.eye(3) / 4)
    spread = GUESSED_FOCAL_DEVIATION**2 * (np.eye(3) - np.outer(pose.direction, pose.direction)) / 4
    return RelativePose(
        pose.rotation,
        pose.direction,
        pose.covariance + along,
        pose.direction_covariance + spread,
        pose.weight,
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
        """Of every pair of views i < j, by their positions."""
        found = {}
        for i, first in enumerate(views):
            known = self._pairs.setdefault(first, WeakKeyDictionary())
            for j, second in enumerate(views[i + 1 :], i + 1):
                if second not in known:
                    known[second] = relate(self.features(first), self.features(second))
                found[i, j] = known[second]
        return found


def peaks(geometry: TwoViewGeometry) -> list[Peak]:
    """What a pair's matches say of its rotation; nothing where they are more likely wrong than right.

    The solver looks for the highest density, and a sharp peak is high however improbable it is: two that are
    wrong, where cameras are free to suit both, would win over one that is right.
    """
    if geometry.probability < TRUSTED:
        return []
    found = []
    for pose in geometry.poses:
        chance = geometry.probability * pose.weight
        exact = WIDENING * pose.covariance + FLOOR**2 * np.eye(3)
        near = exact + NEAR_MISS**2 * np.eye(3)
        found.append(Peak(pose.rotation, exact, (1 - NEAR_MISSES) * chance))
        found.append(Peak(pose.rotation, near, NEAR_MISSES * chance))
    return found
