"""Random scans as data: an object, its surroundings, light, and the cameras that look at it.

Frames: the *object* frame (bounding sphere of radius 1 about the origin, z up) moves with the
object; the *world* frame holds room, light and clutter. They are one when the camera moves around
a thing that lies still; on a turntable, or when somebody turns the thing over between photos, they
are not, and the surroundings tell nothing of the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.captures import objects, shapes, textures
from relpose_ros.captures.assets import Assets, read_picture
from relpose_ros.captures.objects import Part, SyntheticObject
from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import look_at
from relpose_ros.views import BoundingBox, Intrinsics

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.captures.textures import Image

    FloatArray = npt.NDArray[np.float64]

_IMAGE_SIZES = (
    (640, 480),
    (480, 640),
    (1280, 720),
    (720, 1280),
    (960, 960),
    (960, 640),
    (640, 960),
    (540, 960),
)


class Motion(Enum):
    """What moves between two views."""

    CAMERA = "camera"
    TURNTABLE = "turntable"
    """The object turns about z; room and light stay with the camera."""
    HANDLED = "handled"
    """The object is turned over between views: room and light are unrelated to it."""


@dataclass(frozen=True)
class ScanStyle:
    """How the cameras of a scan are drawn."""

    max_neighbour_degrees: tuple[float, float] = (15.0, 180.0)
    """Where each scan draws its largest angle between successive viewing directions from."""
    motions: tuple[float, float, float] = (0.55, 0.3, 0.15)
    """Shares of camera, turntable and handled scans."""
    free_roll: float = 0.15
    """Share of scans whose images are rolled about the optical axis by any angle, as by a wrist camera."""
    crop_scale: tuple[float, float] = (1.1, 1.2)
    """The network's crop: side of the square relative to the box (RelPose++, training)."""
    crop_shift: float = 0.07
    """Largest shift of the crop's centre, in sides of the box."""
    box_error: float = 0.04
    """Standard deviation of the box's edges, relative to its size: detectors are not exact."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One photograph to be rendered."""

    camera_from_object: FloatArray
    """(3, 4), optical."""
    world_from_object: FloatArray
    """(3, 3) rotation: object and world share their origin."""
    intrinsics: Intrinsics
    width: int
    height: int
    box: BoundingBox
    """Around everything of the object that is inside the image; exact."""
    complete: bool
    """Whether the whole object is inside the image."""

    @property
    def camera_from_world(self) -> FloatArray:
        """(3, 4), optical."""
        rotation = self.camera_from_object[:, :3] @ self.world_from_object.T
        return np.column_stack([rotation, self.camera_from_object[:, 3]])


@dataclass(frozen=True, eq=False)
class Surroundings:
    """All that is not the object."""

    panorama: Image
    """(H, 2 H, 3) equirectangular, row 0 up: backdrop and ambient light."""
    room_half: FloatArray
    """(3,) half extents of the box around the origin onto which the panorama is projected."""
    eye: FloatArray
    """(3,) where in that box the panorama was taken."""
    backdrop_blur: float = 0.0
    """Defocus of the panorama, in halvings of its resolution; the light it gives is not affected."""
    ground: Part | None = None
    """What the object stands on; None where it floats."""
    ground_turns: bool = False
    """Whether the ground is fixed in the object frame: a turntable's plate."""
    ground_z: float = -1e3
    """Height of the supporting plane."""
    clutter: tuple[Part, ...] = ()
    """Other things, fixed in the world frame."""
    to_light: FloatArray = field(default_factory=lambda: np.array([0.3, 0.2, 0.93]))
    """(3,) unit vector in the world frame."""
    key: FloatArray = field(default_factory=lambda: np.ones(3))
    """(3,) colour of the direct light."""
    ambient: float = 0.6
    """How much of the panorama's light reaches the object."""
    shadow: float = 0.8
    """How much of the direct light a shadow takes away, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that the renderer needs for one scan."""

    thing: SyntheticObject
    surroundings: Surroundings
    shots: tuple[Shot, ...]
    motion: Motion


def random_scene(
    rng: np.random.Generator, views: int, style: ScanStyle, assets: Assets | None = None
) -> Scene:
    """Draw a scan.

    Args:
        rng: Source of everything; the same state gives the same scan.
        views: Photographs to take.
        style: How cameras are drawn.
        assets: Meshes and pictures beside the procedural ones.
    """
    thing = _posed(rng, objects.random_object(rng, assets))
    motion = (Motion.CAMERA, Motion.TURNTABLE, Motion.HANDLED)[int(rng.choice(3, p=style.motions))]
    points = _outline(thing)
    lowest = float(points[:, 2].min())
    grounded = motion is not Motion.HANDLED and rng.random() < 0.85
    cameras = _cameras(rng, views, style, grounded)
    shots = []
    for rotation, translation, intrinsics, width, height in cameras:
        pose = np.column_stack([rotation, translation])
        box, complete = bounding_box(points, pose, intrinsics, width, height)
        turned = _world_from_object(rng, motion, rotation)
        shots.append(Shot(pose, turned, intrinsics, width, height, box, complete))
    farthest = max(float(np.linalg.norm(shot.camera_from_object[:, 3])) for shot in shots)
    around = _surroundings(rng, motion, lowest if grounded else None, farthest, points, assets)
    return Scene(thing, around, tuple(shots), motion)


def _posed(rng: np.random.Generator, thing: SyntheticObject) -> SyntheticObject:
    """Standing as it would stand, lying on a side, or anyhow; the yaw is always free."""
    kind = rng.random()
    turn = np.eye(3)
    if kind > 0.85:
        turn = so3.random_rotations(1, rng)[0]
    elif kind > 0.7:
        order = rng.permutation(3)
        turn = np.eye(3)[order] * rng.choice((-1.0, 1.0), 3)[:, None]
        turn[0] *= np.linalg.det(turn)
    yaw = rng.uniform(0, 2 * np.pi)
    about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    return thing.transformed(about_z @ turn).normalised()


def _outline(thing: SyntheticObject) -> FloatArray:
    return np.concatenate([part.mesh.positions for part in thing.parts])


def bounding_box(
    points: npt.ArrayLike, camera_from_object: npt.ArrayLike, intrinsics: Intrinsics, width: int, height: int
) -> tuple[BoundingBox, bool]:
    """The box of (M, 3) points inside the image, and whether all of them are inside it.

    Args:
        points: In the object frame.
        camera_from_object: (3, 4).
        intrinsics: Of the image.
        width: Of the image, pixels.
        height: Of the image, pixels.
    """
    pose = np.asarray(camera_from_object, np.float64)
    local = np.asarray(points, np.float64) @ pose[:, :3].T + pose[:, 3]
    depth = np.maximum(local[:, 2], 1e-3)
    u = intrinsics.fx * local[:, 0] / depth + intrinsics.cx
    v = intrinsics.fy * local[:, 1] / depth + intrinsics.cy
    x0, y0, x1, y1 = float(u.min()), float(v.min()), float(u.max()), float(v.max())
    complete = x0 >= 0 and y0 >= 0 and x1 <= width and y1 <= height
    x0, x1 = float(np.clip(x0, 0, width - 2)), float(np.clip(x1, 0, width))
    y0, y1 = float(np.clip(y0, 0, height - 2)), float(np.clip(y1, 0, height))
    return BoundingBox(x0, y0, max(x1, x0 + 2), max(y1, y0 + 2)), complete


def directions(
    rng: np.random.Generator, views: int, largest_step: float, *, above_ground: bool = False
) -> FloatArray:
    """(views, 3) unit vectors from the object to cameras, as a person or a robot would walk.

    Args:
        rng: Source.
        views: How many.
        largest_step: Largest angle between successive directions, degrees.
        above_ground: Whether cameras stay above the supporting plane.
    """
    lowest = 3.0 if above_ground else -10.0
    centre = rng.uniform(lowest + 5, 60)
    spread = rng.uniform(1, 12) if rng.random() < 0.5 else rng.uniform(12, 40)
    azimuth, elevation = rng.uniform(0, 360), float(np.clip(rng.normal(centre, spread), lowest, 85))
    walking = rng.random() < 0.4
    turn = rng.choice((-1.0, 1.0))
    step = rng.uniform(0.4, 1.0) * min(largest_step, 60)
    found = [_direction(azimuth, elevation)]
    while len(found) < views:
        for attempt in range(40):
            shrink = 1.0 if attempt < 20 else 0.5
            if walking:
                wander = azimuth + turn * step * shrink * rng.uniform(0.7, 1.15)
                height = elevation + shrink * rng.normal(0, min(spread, largest_step) / 3)
            else:
                reach = min(180.0, 1.5 * largest_step) * shrink
                wander = azimuth + rng.uniform(-reach, reach)
                height = rng.normal(centre, spread)
            height = float(np.clip(height, lowest, 85))
            candidate = _direction(wander, height)
            if np.degrees(np.arccos(np.clip(candidate @ found[-1], -1, 1))) <= largest_step:
                break
        else:
            # At one height the angle is never larger than the step in azimuth.
            wander, height = azimuth + rng.uniform(-largest_step, largest_step), elevation
            candidate = _direction(wander, height)
        azimuth, elevation = wander, height
        found.append(candidate)
    return np.array(found)


def _direction(azimuth: float, elevation: float) -> FloatArray:
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def _cameras(
    rng: np.random.Generator, views: int, style: ScanStyle, above_ground: bool
) -> list[tuple[FloatArray, FloatArray, Intrinsics, int, int]]:
    """Rotation, translation, intrinsics, width and height of each camera, in the object frame."""
    largest_step = rng.uniform(*style.max_neighbour_degrees)
    toward = directions(rng, views, largest_step, above_ground=above_ground)
    width, height = _IMAGE_SIZES[int(rng.integers(len(_IMAGE_SIZES)))]
    focal = max(width, height) / 2 / np.tan(np.radians(rng.uniform(22, 80)) / 2)
    # The bounding sphere's diameter relative to the image's shorter side; above 1 things are cut.
    filling = rng.uniform(0.35, 0.95) if rng.random() < 0.8 else rng.uniform(0.95, 1.5)
    distance = max(2 * focal / (filling * min(width, height)), 1.6)
    wandering = rng.uniform(0.02, 0.18)
    aim = rng.uniform(0.02, 0.25) * (1.0 if filling > 0.6 else 2.0)
    roll = rng.uniform(0, 6)
    free_roll = rng.random() < style.free_roll
    cx, cy = width / 2 + rng.normal(0, 0.01) * width, height / 2 + rng.normal(0, 0.01) * height
    cameras = []
    for direction in toward:
        away = max(distance * float(np.exp(rng.normal(0, wandering))), 1.45)
        centre = direction * away
        rotation = look_at(centre, np.clip(rng.normal(0, aim, 3), -0.6, 0.6))
        angle = rng.uniform(0, 2 * np.pi) if free_roll else np.radians(rng.normal(0, roll))
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ rotation
        cameras.append((rotation, -rotation @ centre, Intrinsics(focal, focal, cx, cy), width, height))
    return cameras


def _world_from_object(
    rng: np.random.Generator, motion: Motion, camera_from_object: FloatArray
) -> FloatArray:
    if motion is Motion.CAMERA:
        return np.eye(3)
    if motion is Motion.HANDLED:
        return np.asarray(so3.random_rotations(1, rng)[0])
    # The plate has turned such that the camera stands at azimuth 0 of the room.
    forward = camera_from_object[2]
    angle = -np.arctan2(-forward[1], -forward[0])
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _surroundings(
    rng: np.random.Generator,
    motion: Motion,
    ground_z: float | None,
    farthest: float,
    points: FloatArray,
    assets: Assets | None,
) -> Surroundings:
    studio = rng.random() < 0.15
    panorama = _backdrop(rng, assets, studio)
    half = farthest * rng.uniform(1.15, 4) * np.array([1.0, rng.uniform(0.7, 1.4), rng.uniform(0.6, 1.0)])
    half = np.maximum(half, farthest * 1.1) * (20.0 if rng.random() < 0.25 else 1.0)
    eye = half * rng.uniform(-0.4, 0.4, 3) * (1, 1, 0.5)
    ground, turns, clutter = None, False, []
    if ground_z is not None:
        ground, extent = _ground(rng, ground_z, farthest, panorama if studio else None, assets)
        turns = motion is Motion.TURNTABLE and rng.random() < 0.6
        clutter = _clutter(rng, ground_z, extent, points, assets)
    elevation, azimuth = np.radians(rng.uniform(25, 85)), rng.uniform(0, 2 * np.pi)
    strength = rng.uniform(0.25, 1.1)
    tint = 1 + rng.normal(0, 0.06) * np.array([1.0, 0.1, -1.0])
    return Surroundings(
        panorama=panorama,
        room_half=half,
        eye=eye,
        backdrop_blur=float(rng.uniform(0, 3)) if rng.random() < 0.5 else 0.0,
        ground=ground,
        ground_turns=turns,
        ground_z=-1e3 if ground_z is None else ground_z,
        clutter=tuple(clutter),
        to_light=_direction(float(np.degrees(azimuth)), float(np.degrees(elevation))),
        key=strength * tint,
        ambient=float(rng.uniform(0.5, 1.3)),
        shadow=float(rng.uniform(0.4, 1.0)) if rng.random() < 0.8 else 0.0,
    )


def _backdrop(rng: np.random.Generator, assets: Assets | None, studio: bool) -> Image:
    if studio:
        shade = rng.uniform(0.75, 1.0) if rng.random() < 0.7 else rng.uniform(0.02, 0.7)
        colour = np.clip(shade + rng.normal(0, 0.03, 3), 0, 1)
        glow = np.linspace(1.0, rng.uniform(0.6, 1.0), 64)[:, None, None]
        shaded = np.clip(colour * glow * 255, 0, 255).astype(np.uint8)
        return np.repeat(shaded, 128, axis=1)
    if assets is not None and assets.panoramas and rng.random() < 0.75:
        panorama = read_picture(assets.panoramas[int(rng.integers(len(assets.panoramas)))])
    else:
        panorama = textures.room(int(rng.integers(textures.ROOM_COUNT)))
    return np.roll(panorama, int(rng.integers(panorama.shape[1])), axis=1)


def _ground(
    rng: np.random.Generator, z: float, farthest: float, studio: Image | None, assets: Assets | None
) -> tuple[Part, float]:
    """The supporting plane and its half extent."""
    kind = rng.random()
    extent = 12 * farthest if kind < 0.35 else rng.uniform(1.3, 5)
    if studio is not None:
        texture = np.broadcast_to(studio[40, 0], (256, 256, 3)).copy()
        extent = 12 * farthest if rng.random() < 0.6 else extent
    elif rng.random() < 0.15:
        texture = textures.surface(rng, contrast=0.05)
    else:
        texture = textures.surface(rng) if assets is None else assets.random_surface(rng)
    tile = rng.uniform(0.8, 6)
    if rng.random() < 0.4 and extent < 6:
        mesh = shapes.lathe([(0, -0.1), (extent, -0.1), (extent, 0), (0, 0)])
        mesh = shapes.Mesh(mesh.positions, mesh.normals, mesh.positions[:, :2] / tile, mesh.triangles)
    else:
        slab = shapes.box((2 * extent, 2 * extent * rng.uniform(0.6, 1), 0.1)).moved((0, 0, -0.05))
        mesh = shapes.Mesh(slab.positions, slab.normals, slab.positions[:, :2] / tile, slab.triangles)
    angle = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    mesh = mesh.transformed(
        np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), (*rng.normal(0, 0.15, 2), z - 1e-3)
    )
    return Part(
        mesh,
        texture,
        gloss=float(rng.uniform(0, 0.4) * (rng.random() < 0.3)),
        relief=float(rng.uniform(0, 0.02) * (rng.random() < 0.5)),
    ), extent


def _clutter(
    rng: np.random.Generator, z: float, extent: float, points: FloatArray, assets: Assets | None
) -> list[Part]:
    """Cards and other things beside the object, which mostly do not hide it."""
    parts: list[Part] = []
    reach = float(np.linalg.norm(points[:, :2], axis=1).max())
    if rng.random() < 0.25:
        for _ in range(int(rng.integers(1, 5))):
            size, angle = rng.uniform(0.15, 0.5), rng.uniform(0, 2 * np.pi)
            stretch = rng.uniform(0.15, 1.0)
            place = _beside(rng, reach, size, extent)
            card = shapes.box((2 * size, 2 * size * stretch, 0.01))
            c, s = np.cos(angle), np.sin(angle)
            turned = card.transformed(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), (*place, z + 0.005))
            parts.append(Part(turned, textures.scale_card(rng), 0.05))
    if rng.random() < 0.35:
        for _ in range(int(rng.integers(1, 4))):
            other = objects.random_object(rng, None if rng.random() < 0.5 else assets)
            size = rng.uniform(0.3, 1.0)
            low = min(float(part.mesh.positions[:, 2].min()) for part in other.parts)
            place = _beside(rng, reach, size * 1.3, extent)
            other = other.transformed(np.eye(3) * size, np.array([*place, z - low * size]))
            parts += other.parts[:4]
    return parts


def _beside(rng: np.random.Generator, reach: float, size: float, extent: float) -> FloatArray:
    angle = rng.uniform(0, 2 * np.pi)
    away = reach + size + rng.uniform(0, 1.0) * min(extent, 2.5)
    return away * np.array([np.cos(angle), np.sin(angle)])
