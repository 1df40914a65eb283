"""Refines poses by the points that views share, first those of three or more: bundle adjustment.

Intrinsics are fixed. It may only improve: `refine` answers with poses that reproject the same points better,
or with None.

The least squares are our own, since no solver of SciPy's knows that a point ties no other point: on scans of
photographs the sparse steps of `least_squares` (LSMR) took four times as long and stopped short in some of
the long valleys of narrow views; its dense steps were given up on unfinished.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import homogeneous
from relpose_ros.inference.groups import groups
from relpose_ros.inference.uncertainty import SURE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy.typing as npt
    from scipy.sparse import csr_matrix

    from relpose_ros.inference.local_features import LocalFeatures
    from relpose_ros.inference.matches import TwoViewGeometry

    FloatArray = npt.NDArray[np.float64]
    IntArray = npt.NDArray[np.int64]

MOST_POINTS = 400
"""The longest tracks; more cost time and add little."""
LEAST_POINTS = 12
"""Fewer do not hold the poses better than the pairs do."""
LEAST_OBSERVATIONS = 10
"""Of a camera that takes part."""
LEAST_PARALLAX = math.radians(1.5)
ROUNDS = ((60.0, 6.0, 1e-2), (6.0, 1.5, 1e-4))
"""Largest error of a point that takes part and scale of the robust loss, in pixels; relative fall of the cost
in a step below which it was the last. First from poses that are degrees off, then from good ones."""
STEPS = 25
LEAST_INFORMATION = 1e-12
"""On the diagonal of the normal equations, which are then never singular."""
TRANSLATION_DEVIATION = 0.5
"""How loosely translations are held to where they were, in the scan's unit: the scale comes from there."""
ROTATION_DEVIATION = math.radians(20)


@dataclass(frozen=True, eq=False)
class Refined:
    """Better poses."""

    rotations: FloatArray
    """(N, 3, 3) camera_from_object."""
    translations: FloatArray
    """(N, 3)."""
    groups: tuple[tuple[int, ...], ...]
    """Cameras that took part; of what ties one group to another the matches are not sure."""
    error_before: float
    """Median reprojection error, pixels."""
    error_after: float
    information: FloatArray
    """(6 M, 6 M) what the points tell of the M cameras that took part, see `information`."""

    @property
    def moved(self) -> tuple[int, ...]:
        """Cameras that took part, in order."""
        return tuple(sorted(camera for group in self.groups for camera in group))


@dataclass(frozen=True, eq=False)
class _Observations:
    """Q sightings of points."""

    camera: IntArray
    """(Q,)."""
    point: IntArray
    """(Q,)."""
    rays: FloatArray
    """(Q, 2)."""
    pixel: FloatArray
    """(Q,) a pixel in units of the rays."""

    def chosen(self, keep: npt.NDArray[np.bool_]) -> _Observations:
        """Some of them, the points numbered anew."""
        _, point = np.unique(self.point[keep], return_inverse=True)
        return _Observations(self.camera[keep], point.reshape(-1), self.rays[keep], self.pixel[keep])


def refine(
    rotations: FloatArray,
    translations: FloatArray,
    features: Sequence[LocalFeatures],
    geometries: Mapping[tuple[int, int], TwoViewGeometry],
) -> Refined | None:
    """Bundle adjustment of the cameras that see common points; the others stay.

    The first camera that takes part stays where it is too, and with the distance of the others, which a weak
    prior holds, sets frame and unit.

    Args:
        rotations: (N, 3, 3) camera_from_object.
        translations: (N, 3).
        features: of the N views.
        geometries: by pair of views i < j.

    Returns:
        None where too few points are shared, or where the result does not reproject them better.
    """
    seen = _shared_points(_agreeing(rotations, geometries), features)
    if seen is None:
        return None
    here = rotations, translations
    chosen = seen
    for reach, scale, least_gain in ROUNDS:
        points, errors = _triangulate(here, seen)
        good = _well_seen(here, seen, points) & (errors < reach)
        connected = _connected(seen.chosen(_repeated(seen, good)), len(rotations))
        if connected is None:
            return None
        chosen = connected
        points, _ = _triangulate(here, chosen)
        here = _adjust(here, points, chosen, scale, (rotations, translations), least_gain)
    _, before_errors = _triangulate((rotations, translations), chosen)
    points, after_errors = _triangulate(here, chosen)
    before, after = float(np.median(before_errors)), float(np.median(after_errors))
    if not after < before:
        return None
    members = np.unique(chosen.camera)
    # The first round may have moved a camera that the last one left out.
    others = np.setdiff1d(np.arange(len(rotations)), members)
    here[0][others], here[1][others] = rotations[others], translations[others]
    together = _held_together(members, here[0], geometries)
    return Refined(*here, together, before, after, information(here, points, chosen))


def information(poses: tuple[FloatArray, FloatArray], points: FloatArray, seen: _Observations) -> FloatArray:
    """What the sightings tell of the poses whatever the points are: the normal matrix without them.

    Nothing is held, so that it is silent on where all cameras stand together, how they are turned and their
    unit of length. The errors are taken at their own scale, as independent.

    Returns:
        (6 M, 6 M), for each of the M cameras that see something its turn (left perturbation of
        camera_from_object, rad) and its translation.
    """
    state, scale = _State(*poses, points), ROUNDS[-1][1]
    problem = _Problem(seen, scale, poses)
    errors = scale * problem.errors(state)
    free = errors.size - points.size - 6 * len(problem.members) + 7
    # The median length of a Gaussian error in two dimensions is 1.18 deviations; what the points and poses
    # took up of it is given back. No feature is more exact than a third of a pixel.
    deviation = float(np.median(np.linalg.norm(errors, axis=1))) / 1.18
    deviation *= math.sqrt(errors.size / max(free, 1))
    equations = problem.equations(state)
    equations.enlarge(0.0)
    return equations.reduced()[0] * (scale / max(deviation, 1 / 3)) ** 2


def _agreeing(
    rotations: FloatArray, geometries: Mapping[tuple[int, int], TwoViewGeometry]
) -> dict[tuple[int, int], IntArray]:
    """The inliers of those pairs whose pose is that of the cameras."""
    return {
        (i, j): geometry.inliers
        for (i, j), geometry in geometries.items()
        if geometry.agrees(rotations[j] @ rotations[i].T)
    }


def _shared_points(
    matches: Mapping[tuple[int, int], IntArray], features: Sequence[LocalFeatures]
) -> _Observations | None:
    """Tracks of features that match through all views; none that passes a view twice."""
    offsets = np.cumsum([0, *(len(each.rays) for each in features)])
    parent = np.arange(offsets[-1])

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = int(parent[node])
        return node

    nodes: set[int] = set()
    for (i, j), pairs in matches.items():
        for a, b in (pairs + offsets[[i, j]]).tolist():
            nodes.update((a, b))
            parent[root(a)] = root(b)
    tracks: dict[int, list[int]] = {}
    for node in sorted(nodes):
        tracks.setdefault(root(node), []).append(node)
    views = np.searchsorted(offsets, np.arange(offsets[-1]), side="right") - 1
    sound = [
        track for track in tracks.values() if len({int(views[node]) for node in track}) == len(track) > 1
    ]
    # Longest first: a point in two views says no more than their pair did.
    sound = sorted(sound, key=len, reverse=True)[:MOST_POINTS]
    if len(sound) < LEAST_POINTS:
        return None
    members = np.array([node for track in sound for node in track])
    point = np.repeat(np.arange(len(sound)), [len(track) for track in sound])
    camera = views[members]
    rays = np.concatenate([each.rays for each in features])[members]
    return _Observations(camera, point, rays, np.array([each.pixel for each in features])[camera])


def _repeated(seen: _Observations, good: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Good sightings of points that have two or more."""
    counts = np.bincount(seen.point[good], minlength=int(seen.point.max()) + 1)
    return np.asarray(good & (counts[seen.point] >= 2))


def _connected(seen: _Observations, cameras: int) -> _Observations | None:
    """The sightings of the largest group of cameras that share points, each camera with enough of them."""
    while True:
        if len(seen.camera) == 0:
            return None
        group = groups(seen.camera, cameras + seen.point, cameras + int(seen.point.max()) + 1)
        largest = np.bincount(group[seen.camera]).argmax()
        counts = np.bincount(seen.camera, minlength=cameras)
        keep = (group[seen.camera] == largest) & (counts[seen.camera] >= LEAST_OBSERVATIONS)
        if keep.all():
            break
        seen = seen.chosen(_repeated(seen, keep))
    points, members = int(seen.point.max()) + 1, np.unique(seen.camera)
    return seen if points >= LEAST_POINTS and len(members) >= 2 else None


def _held_together(
    members: IntArray, rotations: FloatArray, geometries: Mapping[tuple[int, int], TwoViewGeometry]
) -> tuple[tuple[int, ...], ...]:
    """The members in groups that pairs tie whose matches are sure of the poses; most often one group."""
    sure = [
        (i, j)
        for (i, j), geometry in geometries.items()
        if i in members and j in members and geometry.chance_of(rotations[j] @ rotations[i].T) >= SURE
    ]
    ends = np.array(sure, np.int64).reshape(-1, 2)
    group = groups(ends[:, 0], ends[:, 1], len(rotations))[members]
    return tuple(tuple(members[group == each].tolist()) for each in dict.fromkeys(group.tolist()))


def _triangulate(poses: tuple[FloatArray, FloatArray], seen: _Observations) -> tuple[FloatArray, FloatArray]:
    """The point nearest to its rays (K, 3), and each sighting's reprojection error (Q,) in pixels."""
    rotations, translations = poses
    count = int(seen.point.max()) + 1
    directions = _directions(rotations, seen)
    centres = -np.einsum("nba,nb->na", rotations, translations)[seen.camera]
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(normal, seen.point, across)
    np.add.at(right, seen.point, np.einsum("qab,qb->qa", across, centres))
    points = np.linalg.solve(normal + 1e-9 * np.eye(3), right[..., None])[..., 0]
    in_camera = (
        np.einsum("qab,qb->qa", rotations[seen.camera], points[seen.point]) + translations[seen.camera]
    )
    depth = in_camera[:, 2]
    error = np.linalg.norm(in_camera[:, :2] / np.where(depth > 1e-6, depth, 1)[:, None] - seen.rays, axis=1)
    return np.asarray(points), np.where(depth > 1e-6, error / seen.pixel, np.inf)


def _directions(rotations: FloatArray, seen: _Observations) -> FloatArray:
    """Unit rays in the object frame. -> (Q, 3)."""
    rays = homogeneous(seen.rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(np.einsum("qba,qb->qa", rotations[seen.camera], rays))


def _well_seen(
    poses: tuple[FloatArray, FloatArray], seen: _Observations, points: FloatArray
) -> npt.NDArray[np.bool_]:
    """Whether the point of each sighting is seen from directions far enough apart. -> (Q,)."""
    directions = _directions(poses[0], seen)
    mean = np.zeros_like(points)
    np.add.at(mean, seen.point, directions)
    counts = np.bincount(seen.point, minlength=len(points))
    # Unit vectors with an angle of 2 a between two of them have a mean of length cos a.
    length = np.linalg.norm(mean, axis=1) / counts
    return np.asarray(length[seen.point] < math.cos(LEAST_PARALLAX / 2))


def _adjust(
    poses: tuple[FloatArray, FloatArray],
    points: FloatArray,
    seen: _Observations,
    scale: float,
    prior: tuple[FloatArray, FloatArray],
    least_gain: float,
) -> tuple[FloatArray, FloatArray]:
    """Levenberg and Marquardt's least squares over the poses that take part, but the first, and all points.

    Each step eliminates the points (Schur's complement), which solves it exactly.
    """
    problem = _Problem(seen, scale, prior)
    here = _State(*poses, points)
    cost, damping = problem.cost(here), 1e-3
    for _ in range(STEPS):
        there = problem.stepped(here, damping)
        new_cost = problem.cost(there)
        if new_cost < cost:
            done = cost - new_cost < least_gain * cost
            here, cost, damping = there, new_cost, max(damping / 10, 1e-9)
            if done:
                break
        else:
            damping *= 10
    return here.rotations, here.translations


@dataclass(frozen=True, eq=False)
class _State:
    """What is adjusted."""

    rotations: FloatArray
    """(N, 3, 3) camera_from_object."""
    translations: FloatArray
    """(N, 3)."""
    points: FloatArray
    """(K, 3) in the object frame."""


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations of M cameras and K points, in blocks, of which Q sightings tie a camera to a point."""

    cameras: FloatArray
    """(M, 6, 6)."""
    points: FloatArray
    """(K, 3, 3)."""
    slot: IntArray
    """(Q,) which of the cameras."""
    point: IntArray
    """(Q,)."""
    coupling: FloatArray
    """(Q, 6, 3)."""
    camera_slopes: FloatArray
    """(M, 6)."""
    point_slopes: FloatArray
    """(K, 3)."""

    def without_first(self) -> _Equations:
        """Of the other cameras."""
        others = self.slot > 0
        return _Equations(
            self.cameras[1:],
            self.points,
            self.slot[others] - 1,
            self.point[others],
            self.coupling[others],
            self.camera_slopes[1:],
            self.point_slopes,
        )

    def enlarge(self, damping: float) -> None:
        """The diagonal, by a share of it; a point whose sightings all went astray holds nothing."""
        for blocks in (self.cameras, self.points):
            diagonal = np.einsum("kaa->ka", blocks)
            diagonal += damping * diagonal + LEAST_INFORMATION

    def reduced(self) -> tuple[FloatArray, FloatArray]:
        """The cameras' equations once the points are eliminated: Schur's complement.

        Returns:
            (6 M, 6 M), and the slopes (6 M,).
        """
        eliminated = self._side_by_side(self.coupling @ np.linalg.inv(self.points)[self.point])
        matrix = -eliminated @ self._side_by_side(self.coupling).T
        own = np.arange(len(self.cameras))
        matrix.reshape(len(own), 6, len(own), 6)[own, :, own] += self.cameras
        slopes = self.camera_slopes.reshape(-1) - eliminated @ self.point_slopes.reshape(-1)
        return np.asarray(matrix), np.asarray(slopes)

    def solved(self) -> tuple[FloatArray, FloatArray]:
        """The steps of the cameras (M, 6) and of the points (K, 3)."""
        matrix, slopes = self.reduced()
        steps = -np.linalg.solve(matrix, slopes)
        rest = self.point_slopes + (steps @ self._side_by_side(self.coupling)).reshape(-1, 3)
        shifts = -np.linalg.solve(self.points, rest[..., None])[..., 0]
        return np.asarray(steps.reshape(-1, 6)), np.asarray(shifts)

    def _side_by_side(self, blocks: FloatArray) -> FloatArray:
        """(Q, 6, 3) -> (6 M, 3 K)."""
        whole = np.zeros((len(self.cameras), 6, len(self.points), 3))
        whole[self.slot, :, self.point] = blocks  # a camera sees a point once
        return whole.reshape(6 * len(self.cameras), -1)


class _Problem:
    """What the sightings and the priors ask for."""

    def __init__(self, seen: _Observations, scale: float, prior: tuple[FloatArray, FloatArray]) -> None:
        self._prior = prior
        self._seen, self._scale = seen, scale
        self.members, self._slot = np.unique(seen.camera, return_inverse=True)
        self._free = self.members[1:]
        self._at_camera, self._at_point = _gathered(self._slot), _gathered(seen.point)

    def cost(self, state: _State) -> float:
        """Geman and McClure's robust loss of the reprojection errors, and the priors' squares, by half."""
        square = (self.errors(state) ** 2).sum(1)
        return float((square / (1 + square)).sum() + (self.prior_residuals(state) ** 2).sum()) / 2

    def errors(self, state: _State) -> FloatArray:
        """Of the reprojections, in units of the robust scale. -> (Q, 2)."""
        return self._errors_of(self._in_camera(state)[1])[0]

    def equations(self, state: _State) -> _Equations:
        """Of the sightings alone, weighted as the robust loss has it."""
        residuals, by_camera, by_point = self.weighted(state)
        across_camera, across_point = by_camera.transpose(0, 2, 1), by_point.transpose(0, 2, 1)
        return _Equations(
            _summed(self._at_camera, across_camera @ by_camera),
            _summed(self._at_point, across_point @ by_point),
            self._slot,
            self._seen.point,
            across_camera @ by_point,
            _summed(self._at_camera, (across_camera @ residuals[..., None])[..., 0]),
            _summed(self._at_point, (across_point @ residuals[..., None])[..., 0]),
        )

    def stepped(self, state: _State, damping: float) -> _State:
        """After one step, the diagonal of the normal equations enlarged by the damping."""
        equations = self.equations(state).without_first()
        held = np.repeat([1 / ROTATION_DEVIATION, 1 / TRANSLATION_DEVIATION], 3)
        equations.cameras[:] += np.diag(held**2)
        equations.camera_slopes[:] += held * self.prior_residuals(state)
        equations.enlarge(damping)
        of_cameras, of_points = equations.solved()
        turns, shifts = np.split(of_cameras, 2, 1)
        rotations, translations = state.rotations.copy(), state.translations.copy()
        rotations[self._free] = so3.exp(turns) @ rotations[self._free]
        translations[self._free] += shifts
        return _State(rotations, translations, state.points + of_points)

    def prior_residuals(self, state: _State) -> FloatArray:
        """Turns and shifts of the F free cameras from where they were. -> (F, 6)."""
        turns = so3.log(state.rotations[self._free] @ self._prior[0][self._free].transpose(0, 2, 1))
        shifts = state.translations[self._free] - self._prior[1][self._free]
        return np.concatenate([turns / ROTATION_DEVIATION, shifts / TRANSLATION_DEVIATION], 1)

    def weighted(self, state: _State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Reprojection errors and their derivatives, times the roots of the robust loss's weights.

        Returns:
            (Q, 2); (Q, 2, 6) by turn (left perturbation) and shift of the camera; (Q, 2, 3) by the point.
        """
        turned, p = self._in_camera(state)
        error, depth = self._errors_of(p)
        weight = 1 / (1 + (error**2).sum(1))
        by_p = np.zeros((len(depth), 2, 3))
        by_p[:, 0, 0] = by_p[:, 1, 1] = 1 / depth
        by_p[:, :, 2] = -p[:, :2] / depth[:, None] ** 2
        by_p *= (weight / (self._scale * self._seen.pixel))[:, None, None]
        by_camera = np.concatenate([by_p @ -so3.hat(turned), by_p], -1)
        return weight[:, None] * error, by_camera, by_p @ state.rotations[self._seen.camera]

    def _in_camera(self, state: _State) -> tuple[FloatArray, FloatArray]:
        """Each sighting's point, turned into the axes of its camera, and in its frame. -> (Q, 3) twice."""
        camera = self._seen.camera
        turned = np.einsum("qab,qb->qa", state.rotations[camera], state.points[self._seen.point])
        return turned, turned + state.translations[camera]

    def _errors_of(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Errors in units of the robust scale (Q, 2), and the depths (Q,)."""
        # A point behind its camera has a large error there, and a way back.
        depth = np.maximum(p[:, 2], 1e-3)
        unit = self._scale * self._seen.pixel[:, None]
        return (p[:, :2] / depth[:, None] - self._seen.rays) / unit, depth


def _gathered(place: IntArray) -> csr_matrix:
    """Sums what belongs to the same place, as a matrix. (Q,) of K places -> (K, Q)."""
    from scipy.sparse import csr_matrix

    return csr_matrix((np.ones(len(place)), (place, np.arange(len(place)))))


def _summed(gathered: csr_matrix, blocks: FloatArray) -> FloatArray:
    """(K, Q), (Q, ...) -> (K, ...)."""
    return np.asarray(gathered @ blocks.reshape(len(blocks), -1)).reshape(-1, *blocks.shape[1:])
