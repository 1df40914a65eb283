"""Rotations in three dimensions: exponential and logarithm, quaternions, means.

numpy float64 throughout, on any leading dimensions. Rotation vectors are axis times angle in rad.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]

_SMALL_ANGLE = 1e-4
"""Below it sin(a)/a and its kin are taken from their series, exact there to double precision."""


def hat(vector: npt.ArrayLike) -> FloatArray:
    """Skew matrix of the cross product: ``hat(v) @ w == cross(v, w)``. (..., 3) -> (..., 3, 3)."""
    v = np.asarray(vector, np.float64)
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)


def exp(rotation_vector: npt.ArrayLike) -> FloatArray:
    """Rotation matrix of a rotation vector (Rodrigues). (..., 3) -> (..., 3, 3)."""
    v = np.asarray(rotation_vector, np.float64)
    square = (v * v).sum(-1)[..., None, None]
    angle = np.sqrt(square)
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1 - square / 6, np.sin(safe) / safe)
    second = np.where(small, 0.5 - square / 24, 2 * (np.sin(safe / 2) / safe) ** 2)
    skew = hat(v)
    return np.asarray(np.eye(3) + first * skew + second * (skew @ skew))


def log(rotation: npt.ArrayLike) -> FloatArray:
    """Rotation vector of a rotation matrix, of length at most pi. (..., 3, 3) -> (..., 3).

    Goes through the quaternion, which stays well conditioned at half a turn, where the skew part
    of the matrix vanishes. At exactly half a turn the sign of the axis is arbitrary.
    """
    q = quaternion_xyzw(rotation)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    small = sine < _SMALL_ANGLE
    safe = np.where(small, 1.0, sine)
    scale = np.where(small, 2 + sine * sine / 3, 2 * np.arctan2(sine, q[..., 3:]) / safe)
    return np.asarray(q[..., :3] * scale)


def angle_between(a: npt.ArrayLike, b: npt.ArrayLike) -> FloatArray:
    """Angle of ``a @ b.T`` in rad, 0 to pi; exact to rounding at both ends. (..., 3, 3) twice -> (...)."""
    relative = np.asarray(a, np.float64) @ np.swapaxes(np.asarray(b, np.float64), -1, -2)
    skew = np.stack(
        [
            relative[..., 2, 1] - relative[..., 1, 2],
            relative[..., 0, 2] - relative[..., 2, 0],
            relative[..., 1, 0] - relative[..., 0, 1],
        ],
        -1,
    )
    return np.asarray(np.arctan2(np.linalg.norm(skew, axis=-1), np.trace(relative, axis1=-2, axis2=-1) - 1))


def quaternion_xyzw(rotation: npt.ArrayLike) -> FloatArray:
    """Unit quaternion (x, y, z, w) with w >= 0. (..., 3, 3) -> (..., 4)."""
    r = np.asarray(rotation, np.float64)
    d0, d1, d2 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    x_y, x_z, y_z = r[..., 1, 0] + r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 2, 1] + r[..., 1, 2]
    x_w, y_w, z_w = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    # Row k is 4 q_k q: the one whose own component is largest divides by nothing small.
    outer = np.stack(
        [
            np.stack([1 + d0 - d1 - d2, x_y, x_z, x_w], -1),
            np.stack([x_y, 1 - d0 + d1 - d2, y_z, y_w], -1),
            np.stack([x_z, y_z, 1 - d0 - d1 + d2, z_w], -1),
            np.stack([x_w, y_w, z_w, 1 + d0 + d1 + d2], -1),
        ],
        -2,
    )
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), -1)
    q = np.take_along_axis(outer, best[..., None, None], -2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0, -q, q))


def from_quaternion_xyzw(quaternion: npt.ArrayLike) -> FloatArray:
    """Rotation matrix of a quaternion (x, y, z, w) of any length but zero. (..., 4) -> (..., 3, 3)."""
    q = np.asarray(quaternion, np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return np.stack(rows, -1).reshape(*q.shape[:-1], 3, 3)


def random_rotations(count: int, generator: np.random.Generator) -> FloatArray:
    """``count`` rotations drawn uniformly (Haar measure). -> (count, 3, 3)."""
    return from_quaternion_xyzw(generator.standard_normal((count, 4)))


def ball_fraction(angle: npt.ArrayLike) -> FloatArray:
    """Fraction of all rotations that turn by at most ``angle`` (rad, 0 to pi): (angle - sin angle) / pi."""
    a = np.asarray(angle, np.float64)
    return np.asarray((a - np.sin(a)) / np.pi)


def project(matrix: npt.ArrayLike) -> FloatArray:
    """The rotation nearest to a matrix in the Frobenius norm. (..., 3, 3) -> (..., 3, 3)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, np.float64))
    sign = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    u = np.concatenate([u[..., :2], u[..., 2:] * sign[..., None, None]], -1)
    return np.asarray(u @ vt)


def mean(rotations: npt.ArrayLike, weights: npt.ArrayLike | None = None) -> FloatArray:
    """Chordal mean: the rotation with the least weighted squared Frobenius distance. (K, 3, 3) -> (3, 3)."""
    r = np.asarray(rotations, np.float64)
    w = np.ones(len(r)) if weights is None else np.asarray(weights, np.float64)
    return project(np.einsum("k,kab->ab", w, r))
