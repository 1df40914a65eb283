"""Refines poses by the points that three or more views share: bundle adjustment with fixed intrinsics.

It may only improve: `refine` answers with poses that reproject the same points better, or with None.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import homogeneous

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy.typing as npt

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
ROUNDS = ((60.0, 6.0), (6.0, 1.5))
"""Largest error of a point that takes part, and scale of the robust loss, in pixels: first from poses that
are degrees off, then from good ones."""
STEPS = 12
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
    moved: tuple[int, ...]
    """Cameras that took part."""
    error_before: float
    """Median reprojection error, pixels."""
    error_after: float


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
    for reach, scale in ROUNDS:
        points, errors = _triangulate(here, seen)
        good = _well_seen(here, seen, points) & (errors < reach)
        connected = _connected(seen.chosen(_repeated(seen, good)), len(rotations))
        if connected is None:
            return None
        chosen = connected
        points, _ = _triangulate(here, chosen)
        here = _adjust(here, points, chosen, scale, (rotations, translations))
    _, before_errors = _triangulate((rotations, translations), chosen)
    _, after_errors = _triangulate(here, chosen)
    before, after = float(np.median(before_errors)), float(np.median(after_errors))
    if not after < before:
        return None
    return Refined(here[0], here[1], tuple(np.unique(chosen.camera).tolist()), before, after)


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
        group = np.arange(cameras)
        for point in range(int(seen.point.max()) + 1):
            members = group[seen.camera[seen.point == point]]
            group[np.isin(group, members)] = members.min()
        largest = np.bincount(group[seen.camera]).argmax()
        counts = np.bincount(seen.camera, minlength=cameras)
        keep = (group[seen.camera] == largest) & (counts[seen.camera] >= LEAST_OBSERVATIONS)
        if keep.all():
            break
        seen = seen.chosen(_repeated(seen, keep))
    points, members = int(seen.point.max()) + 1, np.unique(seen.camera)
    return seen if points >= LEAST_POINTS and len(members) >= 2 else None


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
) -> tuple[FloatArray, FloatArray]:
    """Least squares over the poses that take part, but the first, and all points."""
    from scipy.optimize import least_squares

    problem = _Problem(poses, seen, scale, prior)
    start = np.concatenate([np.zeros(6 * len(problem.free)), points.reshape(-1)])
    found = least_squares(
        problem.residuals,
        start,
        problem.jacobian,
        method="trf",
        x_scale="jac",
        tr_solver="lsmr",
        max_nfev=STEPS,
    )
    return problem.poses(found.x)


class _Problem:
    """Residuals and their sparse Jacobian."""

    def __init__(
        self,
        poses: tuple[FloatArray, FloatArray],
        seen: _Observations,
        scale: float,
        prior: tuple[FloatArray, FloatArray],
    ) -> None:
        self._rotations, self._translations = poses
        self._prior = prior
        self._seen, self._scale = seen, scale
        members = np.unique(seen.camera)
        self.free = members[1:]
        self._slot = np.full(len(poses[0]), -1)
        self._slot[self.free] = np.arange(len(self.free))

    def poses(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotations and translations after the steps in ``x``."""
        steps = x[: 6 * len(self.free)].reshape(-1, 6)
        rotations, translations = self._rotations.copy(), self._translations.copy()
        rotations[self.free] = so3.exp(steps[:, :3]) @ rotations[self.free]
        translations[self.free] += steps[:, 3:]
        return rotations, translations

    def _in_camera(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        rotations, translations = self.poses(x)
        points = x[6 * len(self.free) :].reshape(-1, 3)[self._seen.point]
        turned = np.einsum("qab,qb->qa", rotations[self._seen.camera], points)
        return rotations[self._seen.camera], turned, turned + translations[self._seen.camera]

    def residuals(self, x: FloatArray) -> FloatArray:
        """Reprojection errors, squashed as Geman and McClure do, then the priors."""
        _, _, p = self._in_camera(x)
        error, weight, _ = self._errors(p)
        rotations, translations = self.poses(x)
        turns = so3.log(rotations[self.free] @ self._prior[0][self.free].transpose(0, 2, 1))
        shifts = translations[self.free] - self._prior[1][self.free]
        return np.concatenate(
            [
                (weight[:, None] * error).reshape(-1),
                (turns / ROTATION_DEVIATION).reshape(-1),
                (shifts / TRANSLATION_DEVIATION).reshape(-1),
            ]
        )

    def _errors(self, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Errors in units of the robust scale (Q, 2), their weights (Q,) and the depths (Q,)."""
        # A point behind its camera has a large error there, and a way back.
        depth = np.maximum(p[:, 2], 1e-3)
        unit = self._scale * self._seen.pixel[:, None]
        error = (p[:, :2] / depth[:, None] - self._seen.rays) / unit
        return error, 1 / np.sqrt(1 + (error**2).sum(1)), depth

    def jacobian(self, x: FloatArray) -> Any:
        """As a sparse matrix."""
        from scipy.sparse import csr_matrix

        rotation, turned, p = self._in_camera(x)
        error, weight, depth = self._errors(p)
        count, cameras = len(depth), len(self.free)
        unit = self._scale * self._seen.pixel
        by_p = np.zeros((count, 2, 3))
        by_p[:, 0, 0] = by_p[:, 1, 1] = 1 / depth
        by_p[:, :, 2] = -p[:, :2] / depth[:, None] ** 2
        by_p /= unit[:, None, None]
        # Of w e with w = (1 + e e)^(-1/2): w (I - w^2 e e^T).
        squash = weight[:, None, None] * (
            np.eye(2) - weight[:, None, None] ** 2 * error[:, :, None] * error[:, None, :]
        )
        by_p = squash @ by_p
        by_turn = by_p @ -so3.hat(turned)
        by_point = by_p @ rotation
        slot = self._slot[self._seen.camera]
        moving = slot >= 0
        row = 2 * np.arange(count)[:, None, None] + np.arange(2)[:, None]
        blocks = [
            (row[moving], (6 * slot)[moving, None, None] + np.arange(3), by_turn[moving]),
            (row[moving], (6 * slot)[moving, None, None] + 3 + np.arange(3), by_p[moving]),
            (row, 6 * cameras + 3 * self._seen.point[:, None, None] + np.arange(3), by_point),
        ]
        rows = [np.broadcast_to(r, v.shape).reshape(-1) for r, _, v in blocks]
        columns = [np.broadcast_to(c, v.shape).reshape(-1) for _, c, v in blocks]
        values = [v.reshape(-1) for _, _, v in blocks]
        held = np.arange(3 * cameras)
        for part, deviation in enumerate((ROTATION_DEVIATION, TRANSLATION_DEVIATION)):
            rows.append(2 * count + 3 * cameras * part + held)
            columns.append(6 * (held // 3) + 3 * part + held % 3)
            values.append(np.full(3 * cameras, 1 / deviation))
        shape = (2 * count + 6 * cameras, len(x))
        return csr_matrix(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape
        )
