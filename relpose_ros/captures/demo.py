"""The three recorded scans that come with the package, drawn anew by one command.

Nothing here is random but grain: what is in these pictures is chosen so that a person sees at once
what an estimate should look like.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from relpose_ros.captures import shapes, textures
from relpose_ros.captures.folder import save_capture
from relpose_ros.captures.objects import Part, SyntheticObject
from relpose_ros.captures.photography import Camera
from relpose_ros.captures.rendered import JPEG_QUALITY, photographs
from relpose_ros.captures.scenes import Motion, Scene, Shot, Surroundings, bounding_box
from relpose_ros.geometry.cameras import look_at
from relpose_ros.views import Intrinsics

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import numpy.typing as npt

    from relpose_ros.captures.textures import Image

    FloatArray = npt.NDArray[np.float64]

_WIDTH, _HEIGHT = 640, 480
_FOCAL = 620.0
_CAMERA = Camera(
    target=0.5,
    control=0.3,
    balance=(1.0, 1.0, 1.0),
    contrast=1.05,
    saturation=1.0,
    blur=0.0,
    grain=1.5,
    jpeg_quality=100,
    sharpening=0.0,
)


@dataclass(frozen=True)
class DemoScan:
    """One of the recorded scans, before it is a bag."""

    name: str
    """Of the capture folder, the bag and the object."""
    form: Literal["image", "object_view"]
    """Which messages its bag holds."""
    period_s: float
    """Time between two photographs, seconds."""
    scene: Callable[[], Scene]
    object_radius: float
    """Bounding radius of the object, metres."""


def render_demo_captures(folder: Path) -> list[DemoScan]:
    """Write the capture folder of each demo scan into ``folder``, under its name.

    Returns:
        What was written: a caller that makes bags of them finds form and period there.

    Raises:
        RenderError: There is no OpenGL here.
        CaptureError: A capture stands there already.
    """
    for demo in DEMO_SCANS:
        frames = photographs(demo.scene(), _CAMERA, np.random.default_rng(0), unit=demo.object_radius)
        save_capture(folder / demo.name, frames, jpeg_quality=JPEG_QUALITY)
    return list(DEMO_SCANS)


def _textured_object() -> Scene:
    """A tea caddy with four different printed sides, on a wooden table."""
    rng = np.random.default_rng(8)
    panels = [
        _panel(rng, (178, 58, 44), "ASSAM", "black tea"),
        _panel(rng, (236, 226, 198), "No. 12", "250 g"),
        _panel(rng, (34, 92, 82), "GARDEN", "first flush"),
        _panel(rng, (222, 172, 62), "BREW", "4 minutes"),
    ]
    atlas = np.full((512, 768, 3), 60, np.uint8)
    # Faces in the order of shapes.box: +x, +y, +z above, their opposites below.
    for cell, panel in zip(((0, 0), (0, 1), (1, 0), (1, 1)), panels, strict=True):
        row, column = cell
        atlas[256 * row : 256 * row + 256, 256 * column : 256 * column + 256] = panel
    atlas[:256, 512:] = (120, 44, 36)
    square = np.asarray(cv2.resize(atlas, (768, 768), interpolation=cv2.INTER_LINEAR), np.uint8)
    tin = (92, 40, 34)
    lid = shapes.lathe(
        [(0.4, 0.62), (0.4, 0.78), (0.36, 0.8), (0.1, 0.8), (0.07, 0.86), (0.1, 0.92), (0, 0.95)], sectors=64
    )
    thing = SyntheticObject(
        (
            Part(shapes.box((1, 1, 1.24), atlas=True), square, gloss=0.15),
            Part(lid, _plain(tin), gloss=0.4),
        ),
        name="textured_object",
    ).normalised()
    places = [(-75, 22), (-48, 30), (-22, 24), (5, 38), (31, 22), (58, 32), (84, 24), (112, 36)]
    shots = _shots(thing, places, distance=3.1)
    return Scene(thing, _table(thing, wood=True), shots, Motion.CAMERA)


def _ambiguous_mug() -> Scene:
    """A plain glazed mug on a turntable: from behind, where the handle hides, its yaw cannot be seen."""
    t = np.linspace(0, 1, 12)
    outside = 0.42 + 0.03 * t + 0.035 * np.sin(np.pi * t)
    profile = [(0, 0), (0.38, 0), (0.41, 0.02), *zip(outside, 0.03 + 0.97 * t, strict=True)]
    profile += [(outside[-1] - 0.02, 1.015), (outside[-1] - 0.045, 1.0)]
    profile += [*zip(outside[::-1] - 0.045, 0.06 + 0.94 * t[::-1], strict=True), (0, 0.06)]
    ear = shapes.smooth_path(
        [(0.42, 0, 0.84), (0.62, 0, 0.87), (0.76, 0, 0.68), (0.74, 0, 0.42), (0.6, 0, 0.22), (0.42, 0, 0.2)],
        32,
    )
    glaze = textures.coloured(textures.pattern(0, 512), _between((52, 104, 146), (58, 110, 150)))
    thing = SyntheticObject(
        (
            Part(shapes.lathe(profile, sectors=96), glaze, gloss=0.45),
            Part(shapes.tube(ear, 0.055, sides=20, flattening=1.5), glaze, gloss=0.45),
        ),
        name="ambiguous_mug",
    ).normalised()
    places = [(40, 24), (95, 28), (150, 22), (182, 26), (205, 30), (250, 20), (300, 34), (345, 25)]
    shots = _shots(thing, places, distance=3.4, turntable=True)
    return Scene(thing, _table(thing, wood=False), shots, Motion.TURNTABLE)


def _orbit() -> Scene:
    """A toy lorry on a patterned floor, seen by a camera that drives around it."""
    rng = np.random.default_rng(3)
    red, cream, dark = _plain((176, 52, 40)), _plain((226, 214, 186)), _plain((44, 44, 48))
    cargo = np.full((512, 512, 3), (224, 214, 188), np.uint8)
    cv2.rectangle(cargo, (0, 330), (512, 420), (40, 96, 128), -1)
    cv2.putText(cargo, "MILK", (70, 250), cv2.FONT_HERSHEY_DUPLEX, 4.6, (40, 96, 128), 12, cv2.LINE_AA)
    cv2.circle(cargo, (110, 375), 30, (222, 172, 62), -1, cv2.LINE_AA)
    wheel = shapes.lathe(
        [(0, -0.07), (0.17, -0.07), (0.19, -0.05), (0.19, 0.05), (0.17, 0.07), (0, 0.07)], sectors=40
    )
    hub = shapes.lathe([(0.08, 0.07), (0.07, 0.09), (0, 0.095)], sectors=32)
    parts = [
        Part(shapes.box((1.24, 0.72, 0.72)).moved((-0.3, 0, 0.62)), cargo, 0.1),
        Part(
            shapes.superquadric(0.25, 0.2, rings=40, sectors=48)
            .scaled((0.3, 0.34, 0.28))
            .moved((0.66, 0, 0.5)),
            red,
            0.35,
        ),
        Part(shapes.box((0.04, 0.5, 0.2)).moved((0.95, 0, 0.62)), dark, 0.5),
        Part(shapes.box((1.9, 0.5, 0.08)).moved((0.02, 0, 0.2)), dark, 0.1),
        Part(
            shapes.superquadric(0.4, 0.4).scaled((0.08, 0.08, 0.1)).moved((0.6, 0.2, 0.83)),
            _plain((222, 172, 62)),
            0.2,
        ),
    ]
    upright = np.eye(3)[[1, 2, 0]]
    for x in (-0.62, -0.2, 0.66):
        for side in (-1.0, 1.0):
            turned = upright * np.array([[1.0], [side], [1.0]])
            place = (x, side * 0.34, 0.19)
            parts.append(Part(wheel.transformed(turned, place), dark, 0.05))
            parts.append(Part(hub.transformed(turned, place), cream, 0.3))
    thing = SyntheticObject(tuple(parts), name="orbit").normalised()
    steps = np.arange(40)
    wobble = rng.normal(0, 0.4, (40, 2)).cumsum(0) * 0.5
    places = [(-60 + 6 * k + w[0], 24 + 8 * np.sin(k / 9) + w[1]) for k, w in zip(steps, wobble, strict=True)]
    shots = _shots(thing, places, distance=4.4)
    return Scene(thing, _table(thing, wood=False, checked=True), shots, Motion.CAMERA)


def _shots(
    thing: SyntheticObject, places: Sequence[tuple[float, float]], *, distance: float, turntable: bool = False
) -> tuple[Shot, ...]:
    """Photographs from azimuths and elevations (degrees), aimed a little off like a person's."""
    points = np.concatenate([part.mesh.positions for part in thing.parts])
    rng = np.random.default_rng(1)
    intrinsics = Intrinsics(_FOCAL, _FOCAL, _WIDTH / 2, _HEIGHT / 2)
    drift = np.zeros(3)
    shots = []
    for azimuth, elevation in places:
        a, e = np.radians(azimuth), np.radians(elevation)
        drift = 0.8 * drift + rng.normal(0, 0.04, 3)
        centre = (
            distance * (1 + drift[2]) * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
        )
        rotation = look_at(centre, drift)
        pose = np.column_stack([rotation, -rotation @ centre])
        box, complete = bounding_box(points, pose, intrinsics, _WIDTH, _HEIGHT)
        world_from_object = np.eye(3)
        if turntable:
            c, s = np.cos(-a), np.sin(-a)
            world_from_object = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        shots.append(Shot(pose, world_from_object, intrinsics, _WIDTH, _HEIGHT, box, complete))
    return tuple(shots)


def _table(thing: SyntheticObject, *, wood: bool, checked: bool = False) -> Surroundings:
    lowest = min(float(part.mesh.positions[:, 2].min()) for part in thing.parts)
    if checked:
        fields = np.arange(512) // 64
        tiles = np.where((fields[:, None] + fields[None]) % 2 == 0, 200, 168).astype(np.uint8)
        grain = textures.pattern(1, 512) // 10
        texture = np.stack([tiles - grain, tiles - grain - 4, tiles - grain - 12], -1)
        tile, extent = 2.4, 60.0
    elif wood:
        texture, tile, extent = _boards(), 3.2, 3.4
    else:
        texture, tile, extent = _plain((212, 208, 200)), 2.0, 60.0
    slab = shapes.box((2 * extent, 2 * extent, 0.12)).moved((0, 0, lowest - 0.061))
    ground = shapes.Mesh(slab.positions, slab.normals, slab.positions[:, :2] / tile, slab.triangles)
    room = textures.room(5, 768)
    grey = np.repeat(room.mean(-1, keepdims=True), 3, -1) * (1.0, 0.97, 0.92)
    backdrop = cv2.GaussianBlur((0.25 * room + 0.55 * grey).astype(np.uint8), (0, 0), 9)
    if not wood and not checked:
        shade = np.linspace(235, 190, 768)[:, None, None]
        backdrop = np.broadcast_to(shade * np.array([1.0, 0.985, 0.96]), (768, 1536, 3)).astype(np.uint8)
    return Surroundings(
        panorama=np.ascontiguousarray(backdrop),
        room_half=np.array([14.0, 12.0, 8.0]),
        eye=np.array([1.0, -1.0, 0.5]),
        ground=Part(ground, texture, gloss=0.0),
        ground_z=lowest,
        to_light=np.array([0.35, -0.5, 0.79]) / np.linalg.norm([0.35, -0.5, 0.79]),
        key=np.array([0.8, 0.77, 0.72]),
        ambient=0.9,
        shadow=0.75,
    )


def _plain(colour: tuple[int, int, int]) -> Image:
    """One colour with the faint grain that every real surface has."""
    grain = textures.pattern(2, 256)[..., None].astype(np.float64) / 255 - 0.5
    return np.asarray(np.clip(np.asarray(colour) * (1 + 0.06 * grain), 0, 255), np.uint8)


def _between(dark: tuple[int, int, int], light: tuple[int, int, int]) -> Image:
    """(256, 3) palette from one colour to another."""
    place = np.linspace(0, 1, 256)[:, None]
    return np.asarray(np.asarray(dark) * (1 - place) + np.asarray(light) * place, np.uint8)


def _boards() -> Image:
    """Four wooden boards side by side."""
    rng = np.random.default_rng(4)
    height, width = 512, 512
    rows = []
    for _ in range(4):
        grain = textures.fractal_noise(rng, (height // 4, 32), coarsest=24, roughness=0.7)
        long = cv2.resize(grain, (width, height // 4), interpolation=cv2.INTER_CUBIC)
        board = textures.coloured(
            np.asarray(np.clip(long, 0, 1) * 255, np.uint8), _between((108, 72, 44), (168, 122, 78))
        )
        board[:2] = board[:2] // 2
        rows.append(np.clip(board * rng.uniform(0.88, 1.08), 0, 255).astype(np.uint8))
    return np.concatenate(rows)


def _panel(rng: np.random.Generator, colour: tuple[int, int, int], title: str, small: str) -> Image:
    """One printed side, 256 x 256: a frame, a title, an ornament, small print, on patterned paper."""
    image = np.empty((256, 256, 3), np.uint8)
    image[:] = colour
    for _ in range(260):
        spot, radius = rng.integers(0, 256, 2).tolist(), int(rng.integers(2, 6))
        shade = (np.asarray(colour) * float(rng.uniform(0.72, 1.22))).clip(0, 255).astype(int).tolist()
        cv2.circle(image, spot, radius, shade, -1, cv2.LINE_AA)
    dark = sum(colour) < 380
    ink = (244, 234, 206) if dark else (92, 40, 34)
    cv2.rectangle(image, (12, 12), (243, 243), ink, 3)
    size = cv2.getTextSize(title, cv2.FONT_HERSHEY_TRIPLEX, 1.0, 2)[0][0]
    scale = 190 / size
    cv2.putText(image, title, (33, 84), cv2.FONT_HERSHEY_TRIPLEX, scale, ink, 2, cv2.LINE_AA)
    for _ in range(14):
        centre, angle = rng.integers((40, 110), (216, 195)).tolist(), float(rng.uniform(0, 180))
        leaf = (
            (np.asarray(ink) * 0.5 + np.asarray(colour) * 0.5 + rng.normal(0, 25, 3))
            .clip(0, 255)
            .astype(int)
            .tolist()
        )
        cv2.ellipse(image, centre, (22, 8), angle, 0, 360, leaf, -1, cv2.LINE_AA)
        cv2.ellipse(image, centre, (22, 8), angle, 0, 360, ink, 1, cv2.LINE_AA)
    cv2.putText(image, small, (48, 226), cv2.FONT_HERSHEY_COMPLEX, 0.8, ink, 1, cv2.LINE_AA)
    return image


DEMO_SCANS = (
    DemoScan("textured_object", "object_view", 1.0, _textured_object, 0.11),
    DemoScan("ambiguous_mug", "object_view", 1.0, _ambiguous_mug, 0.075),
    DemoScan("orbit", "image", 0.1, _orbit, 0.16),
)
