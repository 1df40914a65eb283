"""Random things: packages, bottles, mugs, statues, tools, toys, furniture, heaps of primitives.

An object is a list of parts with a texture each, centred at its bounding box's centre and scaled to
a bounding sphere of radius 1, z up as it would stand. Meshes of an assets folder come in through
``Assets``; without one everything is procedural.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.captures import shapes, textures
from relpose_ros.captures.shapes import Mesh, Symmetry, SymmetryKind
from relpose_ros.geometry import so3

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from relpose_ros.captures.assets import Assets
    from relpose_ros.captures.textures import Image

    Paint = Callable[[np.random.Generator], Image]
    Build = Callable[[np.random.Generator, Paint], "SyntheticObject"]


@dataclass(frozen=True, eq=False)
class Part:
    """One mesh under one material."""

    mesh: Mesh
    texture: Image
    """(S, S, 3) RGB base colour, repeating."""
    gloss: float = 0.1
    """0 matt to 1 mirror-like."""
    relief: float = 0.0
    """How far bright parts of the texture stand out, in texture widths."""


@dataclass(frozen=True, eq=False)
class SyntheticObject:
    """What is scanned."""

    parts: tuple[Part, ...]
    symmetry: Symmetry = field(default_factory=Symmetry)
    name: str = ""

    def transformed(self, matrix: np.ndarray, offset: np.ndarray | float = 0.0) -> SyntheticObject:
        """Apply ``x -> matrix x + offset``; the symmetry's axis turns with it."""
        moved = tuple(
            replace(p, mesh=p.mesh.transformed(matrix, np.broadcast_to(offset, 3))) for p in self.parts
        )
        symmetry = self.symmetry
        if symmetry.axis is not None:
            axis = matrix @ np.asarray(symmetry.axis)
            axis = axis / np.linalg.norm(axis)
            symmetry = replace(symmetry, axis=(float(axis[0]), float(axis[1]), float(axis[2])))
        return replace(self, parts=moved, symmetry=symmetry)

    def normalised(self) -> SyntheticObject:
        """Centre the bounding box at the origin and scale to a bounding sphere of radius 1."""
        points = np.concatenate([part.mesh.positions for part in self.parts])
        centre = (points.max(0) + points.min(0)) / 2
        radius = float(np.linalg.norm(points - centre, axis=1).max())
        return self.transformed(np.eye(3) / radius, -centre / radius)


def random_object(rng: np.random.Generator, assets: Assets | None = None) -> SyntheticObject:
    """Any kind of thing, as common as seems useful for learning; half of them meshes with assets.

    Assets that are to stay unchanged are all there is.
    """
    if assets is not None and assets.unchanged:
        return assets.random_object(rng).normalised()
    if assets is not None and rng.random() < 0.5:
        thing = assets.random_object(rng)
    else:
        build, _ = _KINDS[int(rng.choice(len(_KINDS), p=_SHARES))]
        thing = build(rng, textures.surface if assets is None else assets.random_surface)
    if rng.random() < 0.3:
        stretch = np.exp(rng.normal(0, 0.2, 3))
        if thing.symmetry.kind is not SymmetryKind.NONE:
            stretch[:2] = stretch[0]
        thing = thing.transformed(np.diag(stretch))
    return thing.normalised()


def _painted(rng: np.random.Generator, mesh: Mesh, paint: Paint) -> Part:
    """A part as ``paint`` draws it; plain ones are less common than on real things, being hard."""
    return _finished(rng, mesh, textures.surface(rng, contrast=0.05) if rng.random() < 0.12 else paint(rng))


def _finished(rng: np.random.Generator, mesh: Mesh, texture: Image) -> Part:
    gloss = 0.0 if rng.random() < 0.55 else rng.uniform(0.05, 0.8)
    relief = 0.0 if rng.random() < 0.5 else rng.uniform(0, 0.02)
    return Part(mesh, texture, gloss=float(gloss), relief=float(relief))


def package(rng: np.random.Generator, paint: Paint) -> SyntheticObject:
    """A printed box with different faces, sometimes with a lid or a second one on it."""
    extents = rng.uniform(0.25, 1.0, 3)
    atlas = np.zeros((256, 384, 3), np.uint8)
    scheme = textures.label(rng, 128, 128) if rng.random() < 0.7 else None
    for row in range(2):
        for column in range(3):
            face = textures.label(rng, 128, 128)
            if scheme is not None:
                # One design: the faces share a ground.
                face = np.where(rng.random() < 0.5, face // 2 + scheme // 2, face)
            atlas[128 * row : 128 * row + 128, 128 * column : 128 * column + 128] = face
    parts = [_finished(rng, shapes.box(extents, atlas=True), _square(atlas))]
    if rng.random() < 0.25:
        lid = shapes.box(extents * (1.03, 1.03, rng.uniform(0.1, 0.3))).moved((0, 0, extents[2] * 0.45))
        parts.append(_painted(rng, lid, paint))
    return SyntheticObject(tuple(parts), name="package")


def _square(image: Image, size: int = 256) -> Image:
    import cv2

    return np.asarray(cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA), np.uint8)


def bottle(rng: np.random.Generator, paint: Paint) -> SyntheticObject:
    """Bottle, can, jar or vase: a lathe with a label around it; without the label it is symmetric."""
    height = rng.uniform(0.8, 3.0)
    neck = rng.uniform(0.25, 1.0)
    if rng.random() < 0.5:
        shoulder, end = rng.uniform(0.5, 0.9) * height, height
        profile = [
            (0, 0),
            (0.93, 0),
            (1, 0.05),
            (1, shoulder),
            (neck, (shoulder + end) / 2),
            (neck, end),
            (0, end),
        ]
    else:
        knots = np.linspace(0, height, 6)
        radius = np.concatenate([rng.uniform(0.4, 1.0, 5), [neck]])
        curve = shapes.smooth_path(np.column_stack([radius, knots, 0 * knots]), 18)[:, :2]
        curve[:, 0] = np.maximum(curve[:, 0], 0.1)
        profile = [(0, 0), *curve.tolist(), (0, height)]
    plain = rng.random() < 0.12
    body = shapes.lathe(profile)
    if plain:
        rings = textures.surface(rng)[:, :1].repeat(256, 1)
        return SyntheticObject(
            (_finished(rng, body, np.ascontiguousarray(rings)),),
            Symmetry(SymmetryKind.CONTINUOUS, (0.0, 0.0, 1.0), 0),
            "lathe",
        )
    parts = [
        _finished(rng, body, paint(rng) if rng.random() < 0.6 else _square(textures.label(rng, 128, 256)))
    ]
    low, high = np.sort(rng.uniform(0.1, 0.7, 2)) * height
    if high - low > 0.15 * height:
        wall = shapes.lathe([(1.012, low), (1.012, high)])
        parts.append(_finished(rng, wall, _square(textures.label(rng, 256, 512))))
    if rng.random() < 0.6:
        cap = rng.uniform(0.9, 1.3) * neck
        top = height + rng.uniform(0.02, 0.3)
        parts.append(
            _painted(rng, shapes.lathe([(cap, height - 0.12), (cap, top), (0, top)], sectors=24), paint)
        )
    if rng.random() < 0.15:
        parts.append(_painted(rng, _handle(rng, 0.95, 0.2 * height, 0.8 * height), paint))
    squash = np.diag([1.0, rng.uniform(0.4, 1.0) if rng.random() < 0.35 else 1.0, 1.0])
    return SyntheticObject(tuple(parts), name="bottle").transformed(squash)


def _handle(rng: np.random.Generator, radius: float, low: float, high: float) -> Mesh:
    """An ear on the side of a vessel, towards +x."""
    reach = rng.uniform(0.35, 0.8)
    points = [
        (radius * 0.95, 0, high),
        (radius + reach * 0.8, 0, high + rng.uniform(-0.1, 0.1)),
        (radius + reach, 0, (low + high) / 2),
        (radius + reach * 0.7, 0, low + rng.uniform(-0.1, 0.1)),
        (radius * 0.95, 0, low),
    ]
    thick = rng.uniform(0.07, 0.14)
    return shapes.tube(shapes.smooth_path(points, 16), thick, sides=10, flattening=rng.uniform(0.8, 1.8))


def mug(rng: np.random.Generator, paint: Paint) -> SyntheticObject:
    """An open vessel: mug, cup, bowl, pot, teapot; the handle is what tells its sides apart."""
    height, flare = rng.uniform(0.7, 2.4), rng.uniform(0.65, 1.3)
    wall = rng.uniform(0.06, 0.14)
    belly = rng.uniform(-0.15, 0.35)
    t = np.linspace(0, 1, 10)
    outside = 1 * (1 - t) + flare * t + belly * np.sin(np.pi * t)
    inside = outside[::-1] - wall
    profile = [(0, 0), (0.85, 0), *zip(outside, t * height, strict=True)]
    profile += [*zip(inside[:-1], t[::-1][:-1] * height, strict=True), (inside[-1], wall), (0, wall)]
    ground = paint(rng) if rng.random() < 0.6 else textures.surface(rng, contrast=rng.uniform(0.05, 0.4))
    body = _finished(rng, shapes.lathe(profile, sectors=40), ground)
    parts = [body]
    if rng.random() < 0.5:
        t0, t1 = 0.2, rng.uniform(0.5, 0.9)
        band = [(np.interp(s, t, outside) + 0.01, s * height) for s in np.linspace(t0, t1, 6)]
        parts.append(_finished(rng, shapes.lathe(band, sectors=40), _square(textures.label(rng, 256, 512))))
    if rng.random() < 0.85:
        ear = _handle(rng, float(np.interp(0.5, t, outside)), 0.2 * height, 0.85 * height)
        parts.append(replace(body, mesh=ear) if rng.random() < 0.6 else _painted(rng, ear, paint))
    if rng.random() < 0.3:
        spout = [
            (-0.8, 0, 0.35 * height),
            (-1.3, 0, 0.5 * height),
            (-1.7, 0, rng.uniform(0.8, 1.05) * height),
        ]
        parts.append(
            replace(body, mesh=shapes.tube(shapes.smooth_path(spout, 12), np.linspace(0.25, 0.1, 12)))
        )
    if rng.random() < 0.3:
        lid = [
            (flare * 0.98, height),
            (flare * 0.5, height * 1.12),
            (0.12, height * 1.2),
            (0.18, height * 1.3),
            (0, height * 1.33),
        ]
        parts.append(_painted(rng, shapes.lathe(lid), paint))
    return SyntheticObject(tuple(parts), name="mug")


def statue(rng: np.random.Generator, paint: Paint) -> SyntheticObject:
    """One material, much relief: busts, animals, stones, figures on a base."""
    stone = textures.pattern(12 * int(rng.integers(40)) + int(rng.integers(3)))
    texture = textures.coloured(stone, textures.palette(rng, contrast=rng.uniform(0.1, 0.5)))
    if rng.random() < 0.4:
        texture = textures.worn(paint(rng), rng)
    relief, gloss = float(rng.uniform(0, 0.03)), float(rng.uniform(0, 0.3))
    blobs = []
    reach = rng.uniform(0.3, 0.7)
    for k in range(int(rng.integers(1, 7))):
        body = shapes.superquadric(*rng.uniform(0.5, 1.4, 2), rings=24, sectors=36)
        body = shapes.displaced(body, rng, rng.uniform(0.03, 0.2), finest=rng.uniform(4, 14))
        size = rng.uniform(0.25, 1.0, 3) * (1.0 if k == 0 else 0.65)
        blobs.append(
            body.transformed(
                so3.random_rotations(1, rng)[0] @ np.diag(size),
                rng.normal(0, reach, 3) * (0.5, 0.5, 1.0) * (k > 0),
            )
        )
    for _ in range(int(rng.integers(0, 5))):
        start = rng.normal(0, 0.4, 3)
        limb = shapes.smooth_path(start + np.cumsum(rng.normal(0, 0.4, (4, 3)), 0), 12)
        blobs.append(shapes.tube(limb, np.linspace(rng.uniform(0.12, 0.3), rng.uniform(0.06, 0.2), 12)))
    parts = [Part(shapes.merge(blobs), texture, gloss, relief)]
    if rng.random() < 0.4:
        low = min(float(blob.positions[:, 2].min()) for blob in blobs)
        extents = (*rng.uniform(0.8, 1.8, 2), rng.uniform(0.2, 1.0))
        parts.append(_painted(rng, shapes.box(extents).moved((0, 0, low - extents[2] / 2 + 0.1)), paint))
    return SyntheticObject(tuple(parts), name="statue")


def tool(rng: np.random.Generator, paint: Paint) -> SyntheticObject:
    """A long handle with a head: hammer, brush, torch, axe; lying down."""
    path = shapes.smooth_path(
        [
            (0, 0, 0),
            (0.8, rng.normal(0, 0.1), rng.normal(0, 0.1)),
            (1.7, rng.normal(0, 0.15), 0),
            (2.4, 0, 0),
        ],
        20,
    )
    radii = np.interp(np.linspace(0, 1, 20), np.linspace(0, 1, 5), rng.uniform(0.1, 0.28, 5))
    parts = [_painted(rng, shapes.tube(path, radii, sides=14, flattening=rng.uniform(0.5, 1.3)), paint)]
    for _ in range(int(rng.integers(1, 4))):
        parts.append(
            _painted(
                rng,
                _primitive(rng)
                .scaled(rng.uniform(0.15, 0.6, 3))
                .moved((2.4 + rng.normal(0, 0.25), *rng.normal(0, 0.12, 2))),
                paint,
            )
        )
    if rng.random() < 0.5:
        place = rng.uniform(0.3, 1.8)
        ring = shapes.lathe([(0.3, -0.1), (0.32, 0), (0.3, 0.1)], sectors=20).transformed(
            np.eye(3)[[2, 0, 1]], (place, 0, 0)
        )
        parts.append(_painted(rng, ring, paint))
    return SyntheticObject(tuple(parts), name="tool")


def toy(rng: np.random.Generator, paint: Paint) -> SyntheticObject:
    """A body on wheels or legs with a cabin or head and small parts that break its symmetry."""
    length, width, height = rng.uniform(1.4, 2.6), rng.uniform(0.6, 1.2), rng.uniform(0.4, 0.9)
    body = shapes.superquadric(*rng.uniform(0.15, 0.9, 2)) if rng.random() < 0.6 else shapes.box((2, 2, 2))
    parts = [_painted(rng, body.scaled((length / 2, width / 2, height / 2)), paint)]
    top = shapes.superquadric(*rng.uniform(0.2, 1, 2)).scaled(rng.uniform(0.25, 0.6, 3))
    parts.append(
        _painted(
            rng, top.moved((rng.uniform(-0.4, 0.5) * length, 0, height / 2 + rng.uniform(0, 0.3))), paint
        )
    )
    wheel = _painted(rng, shapes.lathe([(0, -0.1), (0.3, -0.1), (0.3, 0.1), (0, 0.1)], sectors=20), paint)
    leg = _painted(rng, shapes.lathe([(0, -0.5), (0.14, -0.5), (0.12, 0.5), (0, 0.5)], sectors=12), paint)
    rolling = rng.random() < 0.6
    for x in (-0.32, 0.32):
        for side in (-1, 1):
            place = (x * length, side * (width / 2 if rolling else width / 3), -height / 2)
            mesh = wheel.mesh.transformed(np.eye(3)[[1, 2, 0]], place) if rolling else leg.mesh.moved(place)
            parts.append(replace(wheel if rolling else leg, mesh=mesh))
    for _ in range(int(rng.integers(0, 4))):
        small = _primitive(rng).scaled(rng.uniform(0.06, 0.25, 3))
        parts.append(
            _painted(rng, small.moved(rng.uniform(-0.5, 0.5, 3) * (length, width, height + 0.4)), paint)
        )
    return SyntheticObject(tuple(parts), name="toy")


def furniture(rng: np.random.Generator, paint: Paint) -> SyntheticObject:
    """Chair, stool, table, shelf, lamp: boards and bars."""
    wood = _painted(rng, shapes.box(), paint)
    other = _painted(rng, shapes.box(), paint)
    width, depth, seat = rng.uniform(0.7, 1.6), rng.uniform(0.7, 1.3), rng.uniform(0.4, 1.2)
    bars: list[Part] = [
        replace(other, mesh=shapes.box((width, depth, rng.uniform(0.06, 0.25))).moved((0, 0, seat)))
    ]
    thick = rng.uniform(0.05, 0.14)
    for x in (-1, 1):
        for y in (-1, 1):
            foot, head = (x * width * 0.48, y * depth * 0.48, 0), (x * width * 0.42, y * depth * 0.42, seat)
            bars.append(replace(wood, mesh=shapes.tube([foot, head], thick, sides=8)))
    if rng.random() < 0.7:
        back = shapes.box((width, 0.08, rng.uniform(0.4, 1.1))).moved((0, depth * 0.47, seat + 0.6))
        bars.append(replace(other if rng.random() < 0.6 else wood, mesh=back))
    if rng.random() < 0.5:
        bars.append(
            _painted(
                rng,
                shapes.box((width * 0.9, depth * 0.9, 0.06)).moved((0, 0, seat * rng.uniform(0.3, 0.7))),
                paint,
            )
        )
    for _ in range(int(rng.integers(0, 4))):
        mesh = (
            _primitive(rng).scaled(rng.uniform(0.1, 0.3, 3)).moved((*rng.uniform(-0.3, 0.3, 2), seat + 0.25))
        )
        bars.append(_painted(rng, mesh, paint))
    return SyntheticObject(tuple(bars), name="furniture")


def _primitive(rng: np.random.Generator) -> Mesh:
    kind = int(rng.integers(6))
    if kind == 0:
        return shapes.box((2, 2, 2))
    if kind == 1:
        return shapes.superquadric(*rng.uniform(0.1, 2.2, 2))
    if kind == 2:
        top = rng.uniform(0, 1)
        return shapes.lathe([(0, -1), (1, -1), (top, 1), (0, 1)], sectors=28)
    if kind == 3:
        corners = int(rng.integers(3, 9))
        angle = np.arange(corners * 2) * np.pi / corners
        radius = np.where(np.arange(corners * 2) % 2 == 0, 1.0, rng.uniform(0.4, 1.0))
        return shapes.prism(
            np.column_stack([np.cos(angle), np.sin(angle)]) * radius[:, None], 2.0, taper=rng.uniform(0.3, 1)
        )
    if kind == 4:
        angle = np.linspace(0, rng.uniform(0.7, 2.0) * np.pi, 24)
        ring = np.column_stack([np.cos(angle), np.sin(angle), rng.uniform(0, 0.15) * angle])
        return shapes.tube(ring, rng.uniform(0.1, 0.35), sides=12)
    return shapes.displaced(shapes.superquadric(1, 1), rng, rng.uniform(0.1, 0.25), finest=6)


def heap(rng: np.random.Generator, paint: Paint) -> SyntheticObject:
    """Primitives grown together at random."""
    parts = []
    spread = rng.uniform(0.15, 0.42)
    for k in range(int(rng.integers(2, 8))):
        size = rng.uniform(0.15, 0.6, 3) * (1.4 if k == 0 else 0.8)
        turn = so3.random_rotations(1, rng)[0] if rng.random() < 0.5 else np.eye(3)
        parts.append(
            _painted(
                rng,
                _primitive(rng).transformed(turn @ np.diag(size), rng.normal(0, spread, 3) * (k > 0)),
                paint,
            )
        )
    return SyntheticObject(tuple(parts), name="heap")


def solid(rng: np.random.Generator, paint: Paint) -> SyntheticObject:
    """One primitive under one texture."""
    return SyntheticObject(
        (_finished(rng, _primitive(rng).scaled(rng.uniform(0.4, 1, 3)), paint(rng)),), name="solid"
    )


_KINDS: Sequence[tuple[Build, float]] = (
    (package, 2),
    (bottle, 2),
    (mug, 2),
    (statue, 3),
    (tool, 1.5),
    (toy, 2),
    (furniture, 1.5),
    (heap, 3),
    (solid, 0.7),
)
_SHARES = np.array([share for _, share in _KINDS]) / sum(share for _, share in _KINDS)
