"""Relative poses that explain the matched rays of two views: all of them, not just the first one found.

Narrow views of a small object are nearly orthographic. Two of those leave the angle between them open (the
bas-relief ambiguity: Koenderink and van Doorn 1991), and what perspective there is makes several minima along
it, of which a robust estimator returns any. So the search starts anew at angles all along that family.

Poses are optical ``camera_j_from_camera_i``, the translation of unit length; many are computed at once. Rays
are homogeneous, (M, 3) with z = 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.geometry import so3

if TYPE_CHECKING:
    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]
    BoolArray = npt.NDArray[np.bool_]

ANGLES = np.radians([-78, -60, -44, -30, -18, -8, 8, 18, 30, 44, 60, 78])
"""Between the views, from which to start: a sixth apart in their sines, on both sides, since depths may be
reversed too."""
ITERATIONS = 10
LARGEST_STEP = 0.3
"""Of a rotation in one iteration, rad."""
CAP = 6.0
"""Pixels from which on a match speaks neither for a pose nor more against it."""
DIRECTION_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Poses:
    """S relative poses."""

    rotations: FloatArray
    """(S, 3, 3)."""
    directions: FloatArray
    """(S, 3) unit translations."""

    def __len__(self) -> int:
        """Their number."""
        return len(self.rotations)

    def __getitem__(self, which: slice | BoolArray | npt.NDArray[np.int64]) -> Poses:
        """Some of them."""
        return Poses(self.rotations[which], self.directions[which])

    def __add__(self, other: Poses) -> Poses:
        """These and others."""
        return Poses(
            np.concatenate([self.rotations, other.rotations]),
            np.concatenate([self.directions, other.directions]),
        )

    def moved(self, steps: FloatArray, across: FloatArray) -> Poses:
        """After steps (S, 5): rotation vectors (left perturbation), then along the rows of ``across``."""
        directions = self.directions + np.einsum("ska,sk->sa", across, steps[:, 3:])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return Poses(so3.exp(steps[:, :3]) @ self.rotations, directions)


def distances(poses: Poses, rays_i: FloatArray, rays_j: FloatArray) -> FloatArray:
    """Signed Sampson distances of the matches from the poses' epipolar lines. -> (S, M)."""
    return _linearised(poses, rays_i, rays_j)[0]


def linearised(
    poses: Poses, rays_i: FloatArray, rays_j: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sampson distances and their derivatives by rotation and direction.

    The distance's denominator is taken as constant: it hardly changes where the distance is small.

    Returns:
        (S, M), (S, M, 5), and (S, 2, 3): across the translation, where the last two of a step go.
    """
    distance, turned, across_j, length = _linearised(poses, rays_i, rays_j)
    across = np.linalg.svd(poses.directions[:, None])[2][:, 1:]
    by_rotation = np.cross(turned, across_j)
    by_direction = np.cross(turned, rays_j[None]) @ across.transpose(0, 2, 1)
    return distance, np.concatenate([by_rotation, by_direction], -1) / length[..., None], across


def in_front(poses: Poses, rays_i: FloatArray, rays_j: FloatArray) -> BoolArray:
    """Which matches are of points in front of both cameras. -> (S, M)."""
    a = np.einsum("sab,mb->sma", poses.rotations, rays_i)
    # depth_i a + direction = depth_j b, in the sense of least squares, but for a positive factor.
    aa, bb, ab = (a * a).sum(-1), (rays_j * rays_j).sum(-1), (a * rays_j).sum(-1)
    at, bt = np.einsum("sma,sa->sm", a, poses.directions), poses.directions @ rays_j.T
    return np.asarray((ab * bt > bb * at) & (aa * bt > ab * at))


def costs(poses: Poses, rays_i: FloatArray, rays_j: FloatArray, pixel: float) -> FloatArray:
    """How badly each pose explains all matches: Cauchy's loss, capped; points must lie in front. -> (S,)."""
    size = np.abs(distances(poses, rays_i, rays_j)) / pixel
    size = np.where(in_front(poses, rays_i, rays_j), np.minimum(size, CAP), CAP)
    return np.asarray(np.log1p(size**2).sum(-1))


def refine(poses: Poses, rays_i: FloatArray, rays_j: FloatArray, pixel: float) -> Poses:
    """Each pose by Levenberg and Marquardt's least squares on the distances, with Cauchy weights."""
    damping = np.full(len(poses), 1e-3)
    residuals, jacobian, across = linearised(poses, rays_i, rays_j)
    loss = _cauchy(residuals / pixel)
    for _ in range(ITERATIONS):
        weights = 1 / (1 + (residuals / pixel) ** 2)
        weighted = (jacobian * weights[..., None]).transpose(0, 2, 1)
        normal = weighted @ jacobian
        diagonal = np.einsum("saa->sa", normal) + 1e-9
        damped = normal + (damping[:, None] * diagonal)[:, None] * np.eye(5)
        steps = -np.linalg.solve(damped, weighted @ residuals[..., None])[..., 0]
        turn = np.linalg.norm(steps[:, :3], axis=1, keepdims=True)
        steps *= np.minimum(1, LARGEST_STEP / np.maximum(turn, 1e-12))
        there = poses.moved(steps, across)
        new_residuals, new_jacobian, new_across = linearised(there, rays_i, rays_j)
        new_loss = _cauchy(new_residuals / pixel)
        better = new_loss < loss
        rotations = np.where(better[:, None, None], there.rotations, poses.rotations)
        poses = Poses(rotations, np.where(better[:, None], there.directions, poses.directions))
        residuals = np.where(better[:, None], new_residuals, residuals)
        jacobian = np.where(better[:, None, None], new_jacobian, jacobian)
        across = np.where(better[:, None, None], new_across, across)
        loss = np.where(better, new_loss, loss)
        damping = np.where(better, np.maximum(damping / 10, 1e-9), damping * 10)
    return poses


def turned_along(poses: Poses, rays_i: FloatArray, rays_j: FloatArray, pixel: float) -> Poses:
    """The first pose's family: the same epipolar lines about the middle of the matches, at all `ANGLES`.

    Args:
        poses: One.
        rays_i: (M, 3) of matches that obey it.
        rays_j: (M, 3).
        pixel: Of the features' accuracy, in units of the rays.
    """
    middle_i, middle_j = np.median(rays_i, 0), np.median(rays_j, 0)
    forward_i, forward_j = _onto_axis(middle_i), _onto_axis(middle_j)
    essential = so3.hat(poses.directions[0]) @ poses.rotations[0]
    line_i, line_j = forward_i @ essential.T @ middle_j, forward_j @ essential @ middle_i
    # The lines' normals: points turn about them, and their coordinates along them are all that orthographic
    # views have in common, which says which way round a normal goes.
    coordinates = []
    normals = []
    for forward, rays, line in ((forward_i, rays_i, line_i), (forward_j, rays_j, line_j)):
        normal = line[:2] / max(float(np.linalg.norm(line[:2])), 1e-12)
        local = rays @ forward.T
        along = local[:, :2] @ normal / local[:, 2]
        coordinates.append(along - np.median(along))
        normals.append(normal)
    if coordinates[0] @ coordinates[1] < 0:
        normals[1] = -normals[1]
    angle_i, angle_j = (math.atan2(normal[1], normal[0]) for normal in normals)
    in_plane = so3.exp([0, 0, angle_j - angle_i])
    turns = so3.exp(ANGLES[:, None] * np.append(normals[1], 0)) @ in_plane
    rotations = forward_j.T @ turns @ forward_i
    return Poses(rotations, _directions(rotations, rays_i, rays_j, pixel))


def facing(poses: Poses, rays_i: FloatArray, rays_j: FloatArray) -> Poses:
    """Each translation that way round which has more points in front of the cameras."""
    reversed_ = Poses(poses.rotations, -poses.directions)
    ahead = in_front(poses, rays_i, rays_j).sum(1) >= in_front(reversed_, rays_i, rays_j).sum(1)
    return Poses(poses.rotations, np.where(ahead[:, None], poses.directions, -poses.directions))


def _linearised(
    poses: Poses, rays_i: FloatArray, rays_j: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Distances, and what their derivatives are made of."""
    turned = np.einsum("sab,mb->sma", poses.rotations, rays_i)
    towards = poses.directions[:, None]
    line_j = np.cross(towards, turned)
    across_j = np.cross(rays_j[None], towards)
    line_i = across_j @ poses.rotations
    length = np.sqrt((line_j[..., :2] ** 2).sum(-1) + (line_i[..., :2] ** 2).sum(-1) + 1e-15)
    return (rays_j * line_j).sum(-1) / length, turned, across_j, length


def _directions(rotations: FloatArray, rays_i: FloatArray, rays_j: FloatArray, pixel: float) -> FloatArray:
    """The translation, either way round, that suits the matches best under each rotation. -> (S, 3)."""
    turned = np.einsum("sab,mb->sma", rotations, rays_i)
    normals = np.cross(turned, rays_j[None])  # the translation is perpendicular to all of them
    square = (normals**2).sum(-1)
    weights = 1 / (square + np.median(square, 1, keepdims=True) / 4 + 1e-15)
    for _ in range(DIRECTION_ROUNDS):
        scatter = np.einsum("sm,sma,smb->sab", weights, normals, normals)
        directions = np.asarray(np.linalg.eigh(scatter)[1][:, :, 0])
        misfit = np.einsum("sma,sa->sm", normals, directions)
        line = np.cross(directions[:, None], turned)
        length = (line[..., :2] ** 2).sum(-1) + 1e-15
        weights = 1 / (length * (1 + misfit**2 / (length * (2 * pixel) ** 2)))
        weights = np.minimum(weights, 20 * np.median(weights, 1, keepdims=True))
    return directions


def _onto_axis(ray: FloatArray) -> FloatArray:
    """The smallest rotation that turns a ray onto the optical axis. (3,) -> (3, 3)."""
    axis = np.cross(ray, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    return so3.exp(axis * (math.atan2(sine, ray[2]) / max(sine, 1e-12)))


def _cauchy(errors: FloatArray) -> FloatArray:
    """(S, M) -> (S,)."""
    return np.asarray(np.log1p(errors**2).sum(-1))
