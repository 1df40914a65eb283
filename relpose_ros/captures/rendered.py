"""Rendered scans as capture folders: whole photographs for people, replays and measurements."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.captures import photography
from relpose_ros.captures.folder import Frame, save_capture
from relpose_ros.captures.renderer import Renderer, Window
from relpose_ros.captures.scenes import ScanStyle, Scene, random_scene
from relpose_ros.views import View

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from relpose_ros.captures.assets import Assets
    from relpose_ros.captures.folder import Capture
    from relpose_ros.captures.photography import Camera

SUPERSAMPLING = 3.0
JPEG_QUALITY = 85


def render_capture(
    folder: Path,
    seed: int,
    index: int,
    views: int,
    *,
    assets: Assets | None = None,
    style: ScanStyle | None = None,
) -> Capture:
    """Write scan ``index`` of the endless list that ``seed`` names as a capture folder, masks included.

    Raises:
        RenderError: There is no OpenGL here.
        CaptureError: The folder holds a capture already.
    """
    rng = np.random.default_rng([seed, index])
    scene = random_scene(rng, views, style or ScanStyle(), assets)
    camera = photography.random_camera(rng)
    return save_capture(folder, photographs(scene, camera, rng, masked=True), jpeg_quality=JPEG_QUALITY)


def photographs(
    scene: Scene, camera: Camera, rng: np.random.Generator, *, masked: bool = False, unit: float = 1.0
) -> Iterator[Frame]:
    """Each shot of a scene as a whole photograph, one at a time.

    Args:
        scene: Its object frame becomes the capture's world.
        camera: Develops the pictures.
        rng: Source of what differs between photographs.
        masked: Whether to give the object's mask too.
        unit: Length of the object's bounding radius in the capture's world.
    """
    renderer = Renderer()
    for shot in scene.shots:
        single = Scene(scene.thing, scene.surroundings, (shot,), scene.motion)
        window = Window(0, 0, shot.width, shot.height)
        drawn = renderer.draw(single, [window], (shot.width, shot.height), supersampling=SUPERSAMPLING)[0]
        image = photography.develop(np.ascontiguousarray(drawn[..., :3]), camera, rng)
        pose = shot.camera_from_object.copy()
        pose[:, 3] *= unit
        view = View(
            image=image,
            box=shot.box,
            full_width=shot.width,
            full_height=shot.height,
            intrinsics=shot.intrinsics,
            mask=drawn[..., 3] >= 128 if masked else None,
        )
        yield Frame(view, pose, shot.complete)
