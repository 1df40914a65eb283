"""Endless rendered scans for training: crops as the network sees them, and what is true of them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.captures import photography
from relpose_ros.captures.renderer import Renderer, Window
from relpose_ros.captures.scenes import Motion, ScanSettings, Scene, Shot, random_scene
from relpose_ros.captures.shapes import Symmetry

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.captures.assets import Assets

    FloatArray = npt.NDArray[np.float64]

PLACE_STRIDE = 8
"""Pixels of a crop per cell of the map of object coordinates."""


@dataclass(frozen=True, eq=False)
class RenderedScan:
    """N views of one object."""

    images: npt.NDArray[np.uint8]
    """(N, S, S, 3) RGB crops, black outside the photograph."""
    coverage: npt.NDArray[np.uint8]
    """(N, S, S) how much of each pixel the object covers, 0 to 255."""
    crop_parameters: FloatArray
    """(N, 3) the crop's place and size, as the network takes them (see ``crop_parameters``)."""
    crops: FloatArray
    """(N, 3) left, top and side of the crop, pixels of the full image."""
    image_sizes: npt.NDArray[np.int64]
    """(N, 2) width and height of the full image."""
    camera_from_object: FloatArray
    """(N, 3, 4) optical; the object's bounding sphere has radius 1 and stands at the origin."""
    intrinsics: FloatArray
    """(N, 4) fx, fy, cx, cy of the full image, corner convention."""
    places: npt.NDArray[np.float16]
    """(N, S // 8, S // 8, 3) object coordinates seen at the centre of each cell, NaN off the object."""
    complete: npt.NDArray[np.bool_]
    """(N,) whether the whole object is inside the photograph."""
    symmetry: Symmetry
    motion: Motion
    name: str


class ScanRenderer:
    """Draws scan ``index`` of an endless list, the same for the same seed and settings."""

    def __init__(
        self,
        seed: int,
        image_size: int = 128,
        *,
        assets: Assets | None = None,
        settings: ScanSettings | None = None,
    ) -> None:
        """Open an OpenGL context.

        Args:
            seed: Names the list of scans.
            image_size: Side of the crops, pixels, a multiple of 8.
            assets: Meshes and pictures beside the procedural ones.
            settings: How cameras are drawn.

        Raises:
            RenderError: There is no OpenGL here.
        """
        self._seed = seed
        self._size = image_size
        self._assets = assets
        self._settings = settings or ScanSettings()
        self._renderer = Renderer()

    def scan(self, index: int, views: int) -> RenderedScan:
        """Render scan ``index`` with so many views."""
        rng = np.random.default_rng([self._seed, index])
        scene = random_scene(rng, views, self._settings, self._assets)
        crops = np.array([_crop(rng, shot, self._settings) for shot in scene.shots])
        windows = [Window(x, y, side, side) for x, y, side in crops]
        # Real crops are shrunk with little or no filtering: some scans are as jagged.
        drawn, places = self._renderer.draw_with_places(
            scene,
            windows,
            (self._size, self._size),
            PLACE_STRIDE,
            supersampling=1 if rng.random() < 0.3 else 2,
            sharpness=float(rng.uniform(-0.7, 0.3)),
        )
        camera = photography.random_camera(rng)
        images = np.stack(
            [
                photography.develop(np.ascontiguousarray(picture[..., :3]), camera, rng, _within(shot, window, self._size))
                for picture, shot, window in zip(drawn, scene.shots, windows, strict=True)
            ]
        )
        sizes = np.array([(shot.width, shot.height) for shot in scene.shots])
        return RenderedScan(
            images=images,
            coverage=np.ascontiguousarray(drawn[..., 3]),
            crop_parameters=crop_parameters(crops, sizes),
            crops=crops,
            image_sizes=sizes,
            camera_from_object=np.stack([shot.camera_from_object for shot in scene.shots]),
            intrinsics=np.array([[getattr(s.intrinsics, f.name) for f in fields(s.intrinsics)] for s in scene.shots]),
            places=places,
            complete=np.array([shot.complete for shot in scene.shots]),
            symmetry=scene.thing.symmetry,
            motion=scene.motion,
            name=scene.thing.name,
        )


def _crop(rng: np.random.Generator, shot: Shot, settings: ScanSettings) -> tuple[float, float, float]:
    """Left, top and side of a training crop around a detector's box (RelPose++, section 4)."""
    box = shot.box
    wrong = rng.normal(0, settings.box_error, 4) * (box.width, box.height, box.width, box.height)
    x0, y0 = max(box.x0 + wrong[0], 0), max(box.y0 + wrong[1], 0)
    x1, y1 = min(box.x1 + wrong[2], shot.width), min(box.y1 + wrong[3], shot.height)
    side = max(x1 - x0, y1 - y0, 8.0) * rng.uniform(*settings.crop_scale)
    shift = rng.uniform(-settings.crop_shift, settings.crop_shift, 2) * side
    left, top = (x0 + x1) / 2 + shift[0] - side / 2, (y0 + y1) / 2 + shift[1] - side / 2
    return float(round(left)), float(round(top)), float(round(side))


def crop_parameters(crops: npt.ArrayLike, image_sizes: npt.ArrayLike) -> FloatArray:
    """The crops' places as the network is told them, (N, 3).

    Centre and side relative to the full image's shorter side, the centre's sign turned
    (PyTorch3D's x left, y up): ``-(2 c / m - 1)`` and ``2 s / m``.

    Args:
        crops: (N, 3) left, top, side in pixels of the full image.
        image_sizes: (N, 2) width, height.
    """
    square, size = np.asarray(crops, np.float64), np.asarray(image_sizes, np.float64)
    shorter = size.min(1)
    centre = square[:, :2] + square[:, 2:] / 2
    return np.column_stack([1 - 2 * centre / shorter[:, None], 2 * square[:, 2] / shorter])


def _within(shot: Shot, window: Window, size: int) -> npt.NDArray[np.bool_] | None:
    """(size, size) where the crop shows the photograph; None where it does everywhere."""
    if window.x0 >= 0 and window.y0 >= 0:
        if window.x0 + window.width <= shot.width and window.y0 + window.height <= shot.height:
            return None
    centre = (np.arange(size) + 0.5) / size
    x, y = window.x0 + centre * window.width, window.y0 + centre * window.height
    return np.asarray(((y >= 0) & (y < shot.height))[:, None] & ((x >= 0) & (x < shot.width))[None])


__all__ = ["PLACE_STRIDE", "RenderedScan", "ScanRenderer", "ScanSettings", "Scene", "crop_parameters"]
