"""Triangle meshes of procedural bodies: lathes, superquadrics, tubes, prisms, boxes.

Coordinates are right-handed with z up. Every function that builds a body is deterministic in its
arguments; the random ones take a generator.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]

CREASE_DEGREES = 40.0
"""Neighbouring faces that meet at a larger angle keep a hard edge."""


class SymmetryKind(IntEnum):
    """Which rotations leave an object looking the same."""

    NONE = 0
    DISCRETE = 1
    CONTINUOUS = 2


@dataclass(frozen=True)
class Symmetry:
    """Rotations about one axis that leave shape and colour of an object unchanged.

    Surroundings and light are not counted: they may still tell the views of a symmetric object apart.
    """

    kind: SymmetryKind = SymmetryKind.NONE
    axis: tuple[float, float, float] | None = None
    """Unit vector in the object frame; None where there is no symmetry or its axis is unknown."""
    order: int = 1
    """n for multiples of 360/n degrees; 0 where it is continuous or unknown."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh with vertices split wherever normals or texture coordinates jump."""

    positions: FloatArray
    """(V, 3)."""
    normals: FloatArray
    """(V, 3), unit length."""
    uvs: FloatArray
    """(V, 2), texture coordinates, repeating outside 0..1."""
    triangles: npt.NDArray[np.int64]
    """(F, 3) vertex indices."""

    def transformed(self, matrix: npt.ArrayLike, offset: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
        """Apply ``x -> matrix x + offset`` (3x3, any invertible one)."""
        m = np.asarray(matrix, np.float64)
        normals = self.normals @ np.linalg.inv(m)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return replace(self, positions=self.positions @ m.T + np.asarray(offset, np.float64), normals=normals)

    def scaled(self, factors: npt.ArrayLike) -> Mesh:
        """Stretch along x, y and z; one number scales all."""
        return self.transformed(np.diag(np.broadcast_to(np.asarray(factors, np.float64), 3)))

    def moved(self, offset: npt.ArrayLike) -> Mesh:
        """Translate."""
        return replace(self, positions=self.positions + np.asarray(offset, np.float64))


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh with the triangles of all."""
    starts = np.cumsum([0] + [len(mesh.positions) for mesh in meshes])
    return Mesh(
        positions=np.concatenate([mesh.positions for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        uvs=np.concatenate([mesh.uvs for mesh in meshes]),
        triangles=np.concatenate([m.triangles + start for m, start in zip(meshes, starts, strict=False)]),
    )


def creased(
    positions: npt.ArrayLike,
    triangles: npt.ArrayLike,
    uvs: npt.ArrayLike,
    crease_degrees: float = CREASE_DEGREES,
) -> Mesh:
    """Give a mesh without normals smooth ones, with hard edges where faces meet at a large angle.

    Vertices at the same place count as one for the normals, whatever their texture coordinates.

    Args:
        positions: (V, 3).
        triangles: (F, 3) vertex indices.
        uvs: (V, 2).
        crease_degrees: A corner whose face turns away from the smooth normal by more stays flat. The
            edge of a box turns by 45 degrees.
    """
    v, f, uv = np.asarray(positions, np.float64), np.asarray(triangles, np.int64), np.asarray(uvs, np.float64)
    _, place = np.unique(np.round(v * 1e5).astype(np.int64), axis=0, return_inverse=True)
    place = place.reshape(-1)[f]
    face = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-20)
    smooth = np.zeros((int(place.max()) + 1, 3))
    for corner in range(3):
        # Weighted by the corner's angle: how a side is cut into triangles then makes no difference.
        one = v[f[:, (corner + 1) % 3]] - v[f[:, corner]]
        other = v[f[:, (corner + 2) % 3]] - v[f[:, corner]]
        angle = np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), (one * other).sum(1))
        np.add.at(smooth, place[:, corner], face * angle[:, None])
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-20)
    corners = smooth[place]
    flat = np.broadcast_to(face[:, None], corners.shape)
    hard = (corners * flat).sum(-1) < np.cos(np.radians(crease_degrees))
    hard &= flat.any(-1)  # a triangle without area has no normal of its own
    corners = np.where(hard[..., None], flat, corners)
    # Corners that agree in place, texture and normal share one vertex: a third of the vertex work.
    key = np.concatenate([f.reshape(-1, 1), np.round(corners.reshape(-1, 3) * 200).astype(np.int64)], 1)
    _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
    source = f.reshape(-1)[first]
    return Mesh(v[source], corners.reshape(-1, 3)[first], uv[source], index.reshape(-1, 3))


def grid_surface(points: FloatArray, *, u_repeat: float = 1.0, v_repeat: float = 1.0) -> Mesh:
    """A smooth surface through a (M, N, 3) grid of points; outside is where d/du x d/dv points.

    Texture coordinates run from 0 to u_repeat along the first index, to v_repeat along the second.
    A first and last row (or column) at the same places is a seam: it is smooth across.
    """
    m, n = points.shape[:2]
    du, dv = np.gradient(points, axis=0), np.gradient(points, axis=1)
    if np.allclose(points[0], points[-1]):
        du[0] = du[-1] = (points[1] - points[-2]) / 2
    if np.allclose(points[:, 0], points[:, -1]):
        dv[:, 0] = dv[:, -1] = (points[:, 1] - points[:, -2]) / 2
    normals = np.cross(du, dv)
    # At a pole, where a whole line is one point, a tangent vanishes: its neighbours' mean is its normal.
    for lines, places in ((normals, points), (normals.swapaxes(0, 1), points.swapaxes(0, 1))):
        for pole, beside in ((0, 1), (-1, -2)):
            if np.allclose(places[pole], places[pole, 0]):
                lines[pole] = lines[beside].sum(0)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = normals / np.maximum(length, 1e-12)
    u, v = np.meshgrid(np.linspace(0, u_repeat, m), np.linspace(0, v_repeat, n), indexing="ij")
    corner = (np.arange(m - 1)[:, None] * n + np.arange(n - 1)[None]).reshape(-1)
    triangles = np.concatenate(
        [
            np.stack([corner, corner + n, corner + n + 1], 1),
            np.stack([corner, corner + n + 1, corner + 1], 1),
        ]
    )
    return Mesh(points.reshape(-1, 3), normals.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2), triangles)


def superquadric(
    vertical: float = 1.0, horizontal: float = 1.0, *, rings: int = 20, sectors: int = 32
) -> Mesh:
    """Superellipsoid of semi-axes 1 (Barr 1981): exponents near 0 make boxes, 1 a sphere, 2 an octahedron."""

    def power(x: FloatArray, exponent: float) -> FloatArray:
        return np.asarray(np.sign(x) * np.abs(x) ** exponent)

    latitude = np.linspace(-np.pi / 2, np.pi / 2, rings)[None, :]
    longitude = np.linspace(-np.pi, np.pi, sectors + 1)[:, None]
    radius = power(np.cos(latitude), vertical)
    points = np.stack(
        [
            radius * power(np.cos(longitude), horizontal),
            radius * power(np.sin(longitude), horizontal),
            np.broadcast_to(power(np.sin(latitude), vertical), (sectors + 1, rings)),
        ],
        -1,
    )
    points[:, 0] = points[:, 0].mean(0)
    points[:, -1] = points[:, -1].mean(0)
    return grid_surface(points)


def lathe(profile: npt.ArrayLike, *, sectors: int = 36, u_repeat: float = 1.0) -> Mesh:
    """Surface of revolution about z of a (P, 2) profile of (radius, height), bottom to top outside.

    Corners of the profile sharper than the crease angle stay hard. The texture's u runs around, its
    v along the profile's length.
    """
    corners = np.asarray(profile, np.float64)
    step = np.diff(corners, axis=0)
    length = np.linalg.norm(step, axis=1)
    keep = length > 1e-9
    corners, step, length = np.concatenate([corners[:1], corners[1:][keep]]), step[keep], length[keep]
    # The outward normal of a profile that runs upward outside.
    flat = np.stack([step[:, 1], -step[:, 0]], 1) / length[:, None]
    along = np.concatenate([[0.0], np.cumsum(length)]) / length.sum()
    start, end = flat.copy(), flat.copy()
    soft = (flat[1:] * flat[:-1]).sum(1) > np.cos(np.radians(CREASE_DEGREES))
    mean = flat[1:] + flat[:-1]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    end[:-1][soft] = mean[soft]
    start[1:][soft] = mean[soft]
    ring_rz = np.stack([corners[:-1], corners[1:]], 1).reshape(-1, 2)
    ring_normal = np.stack([start, end], 1).reshape(-1, 2)
    ring_v = np.stack([along[:-1], along[1:]], 1).reshape(-1)
    angle = np.linspace(-np.pi, np.pi, sectors + 1)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]

    def around(rz: FloatArray) -> FloatArray:
        r, z = rz[None, :, 0], rz[None, :, 1]
        return np.stack([r * cos, r * sin, np.broadcast_to(z, (len(angle), z.shape[1]))], -1).reshape(-1, 3)

    rings = len(ring_rz)
    uv = np.stack(np.broadcast_arrays(np.linspace(0, u_repeat, sectors + 1)[:, None], ring_v[None]), -1)
    corner = (np.arange(sectors)[:, None] * rings + np.arange(0, rings, 2)[None]).reshape(-1)
    triangles = np.concatenate(
        [
            np.stack([corner, corner + rings, corner + rings + 1], 1),
            np.stack([corner, corner + rings + 1, corner + 1], 1),
        ]
    )
    return Mesh(around(ring_rz), around(ring_normal), uv.reshape(-1, 2), triangles)


def box(extents: npt.ArrayLike = (1.0, 1.0, 1.0), *, atlas: bool = False) -> Mesh:
    """Axis-aligned box about the origin.

    Args:
        extents: Edge lengths.
        atlas: Six different faces of a texture of three by two panels; otherwise each face shows all of it.
    """
    half = np.asarray(extents, np.float64) / 2
    positions, normals, uvs, triangles = [], [], [], []
    for face in range(6):
        axis, sign = face % 3, 1.0 if face < 3 else -1.0
        normal = np.zeros(3)
        normal[axis] = sign
        up = np.array([0.0, 1.0, 0.0]) if axis == 2 else np.array([0.0, 0.0, 1.0])
        right = np.cross(up, normal)
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float64)
        positions.append((normal + square[:, :1] * right + square[:, 1:] * up) * half)
        normals.append(np.tile(normal, (4, 1)))
        uv = (square * (1, -1) + 1) / 2
        uvs.append((uv + np.array([face % 3, face // 3])) / (3, 2) if atlas else uv)
        triangles.append(np.array([[0, 1, 2], [0, 2, 3]]) + 4 * face)
    return Mesh(*(np.concatenate(parts) for parts in (positions, normals, uvs, triangles)))


def tube(path: npt.ArrayLike, radii: npt.ArrayLike, *, sides: int = 12, flattening: float = 1.0) -> Mesh:
    """Round bar along a (P, 3) path with a radius at each point, closed by flat ends.

    Args:
        path: Points; neighbours must differ.
        radii: (P,) or one number.
        sides: Corners of the cross-section.
        flattening: Width of the cross-section along its second axis relative to the first.
    """
    points = np.asarray(path, np.float64)
    radius = np.broadcast_to(np.asarray(radii, np.float64), (len(points),))
    tangent = np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    first = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    frames = []
    for direction in tangent:
        # The frame is carried along, not taken anew, so that the bar does not twist.
        first = first - direction * (first @ direction)
        first = first / np.linalg.norm(first)
        frames.append((first, np.cross(direction, first)))
    a, b = np.array([f[0] for f in frames]), np.array([f[1] for f in frames])
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    circle = np.cos(angle)[:, None, None] * a - flattening * np.sin(angle)[:, None, None] * b
    side = grid_surface((points + radius[:, None] * circle).swapaxes(0, 1), v_repeat=2.0)
    ends = [
        _fan(points[k] + radius[k] * circle[:-1, k][::order], tangent[k] * -order)
        for k, order in ((0, 1), (-1, -1))
    ]
    return merge([side, *ends])


def prism(outline: npt.ArrayLike, height: float, *, taper: float = 1.0) -> Mesh:
    """Upright prism about the origin over a (P, 2) outline, counter-clockwise and star-shaped about 0.

    Args:
        outline: Corners of the base.
        height: Extent along z.
        taper: Size of the top relative to the base.
    """
    corners = np.asarray(outline, np.float64)
    low = np.column_stack([corners, np.full(len(corners), -height / 2)])
    high = np.column_stack([corners * taper, np.full(len(corners), height / 2)])
    positions, normals, uvs, triangles = [], [], [], []
    edge = np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1)
    along = np.concatenate([[0.0], np.cumsum(edge)]) / edge.sum()
    for k in range(len(corners)):
        following = (k + 1) % len(corners)
        quad = np.stack([low[k], low[following], high[following], high[k]])
        normal = np.cross(quad[1] - quad[0], quad[2] - quad[0])
        positions.append(quad)
        normals.append(np.tile(normal / np.linalg.norm(normal), (4, 1)))
        u0, u1 = along[k], along[k + 1]
        uvs.append(np.array([[u0, 1], [u1, 1], [u1, 0], [u0, 0]]))
        triangles.append(np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k)
    side = Mesh(*(np.concatenate(parts) for parts in (positions, normals, uvs, triangles)))
    return merge([side, _fan(high, np.array([0.0, 0.0, 1.0])), _fan(low[::-1], np.array([0.0, 0.0, -1.0]))])


def _fan(ring: FloatArray, normal: FloatArray) -> Mesh:
    """Flat cap of a ring of points that runs counter-clockwise about its normal."""
    count = len(ring)
    positions = np.concatenate([ring, ring.mean(0, keepdims=True)])
    extent = max(float(np.ptp(ring, axis=0).max()), 1e-9)
    axes = np.argsort(np.abs(normal))[:2]
    uv = (positions - positions[-1])[:, axes] / extent + 0.5
    k = np.arange(count)
    return Mesh(
        positions,
        np.tile(normal, (count + 1, 1)),
        uv,
        np.stack([k, (k + 1) % count, np.full(count, count)], 1),
    )


def displaced(mesh: Mesh, rng: np.random.Generator, amount: float, finest: float = 8.0) -> Mesh:
    """Push vertices in and out by a smooth random field: stones, busts, dented things.

    Args:
        mesh: A closed body; places that coincide stay together.
        rng: Source of the field.
        amount: Typical displacement, in the mesh's unit.
        finest: Highest spatial frequency, rad per unit.
    """
    frequencies = np.geomspace(1.5, finest, 10)
    direction = rng.normal(size=(10, 3))
    direction *= (frequencies / np.linalg.norm(direction, axis=1))[:, None]
    strength = amount * rng.normal(size=10) * (1.5 / frequencies) ** 0.8
    phase = rng.uniform(0, 2 * np.pi, 10)
    argument = mesh.positions @ direction.T + phase
    height = np.sin(argument) @ strength
    gradient = (np.cos(argument) * strength) @ direction
    # Moving along the direction from the origin keeps seams closed: it depends on the place alone.
    ray = mesh.positions / np.maximum(np.linalg.norm(mesh.positions, axis=1, keepdims=True), 1e-9)
    normals = mesh.normals - (gradient - (gradient * mesh.normals).sum(1, keepdims=True) * mesh.normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return replace(mesh, positions=mesh.positions + height[:, None] * ray, normals=normals)


def smooth_path(points: npt.ArrayLike, count: int) -> FloatArray:
    """(count, 3) points of the Catmull-Rom curve through (P, 3) points."""
    p = np.asarray(points, np.float64)
    padded = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    place = np.linspace(0, len(p) - 1, count)
    segment = np.minimum(place.astype(int), len(p) - 2)
    t = (place - segment)[:, None]
    a, b, c, d = (padded[segment + k] for k in range(4))
    return np.asarray(
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
    )
