"""Endless rendered scans for training: crops as the network sees them, and what is true of them."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.captures import photography
from relpose_ros.captures.renderer import Renderer, RenderError, Window
from relpose_ros.captures.scenes import Motion, ScanStyle, Shot, random_scene
from relpose_ros.network.crops import crop_parameters, crop_square
from relpose_ros.views import BoundingBox

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.captures.assets import Assets
    from relpose_ros.captures.shapes import Symmetry

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
    crop_parameters: npt.NDArray[np.float32]
    """(N, 3) the crop's place and size, as the network takes them."""
    crops: npt.NDArray[np.int64]
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
    """Draws scan ``index`` of an endless list, the same for the same seed and style."""

    def __init__(
        self,
        seed: int,
        image_size: int = 128,
        *,
        assets: Assets | None = None,
        style: ScanStyle | None = None,
    ) -> None:
        """Open an OpenGL context.

        Args:
            seed: Names the list of scans.
            image_size: Side of the crops, pixels, a multiple of 8.
            assets: Meshes and pictures beside the procedural ones.
            style: How cameras are drawn.

        Raises:
            RenderError: There is no OpenGL here, or the size is no multiple of 8.
        """
        if image_size <= 0 or image_size % PLACE_STRIDE:
            text = f"the side of a crop is {image_size} pixels; it must be a multiple of {PLACE_STRIDE}."
            raise RenderError(text)
        self._seed = seed
        self._size = image_size
        self._assets = assets
        self._style = style or ScanStyle()
        self._renderer = Renderer()

    def scan(self, index: int, views: int) -> RenderedScan:
        """Render scan ``index`` with so many views."""
        rng = np.random.default_rng([self._seed, index])
        scene = random_scene(rng, views, self._style, self._assets)
        crops = [_crop(rng, shot, self._style) for shot in scene.shots]
        windows = [Window(x, y, side, side) for x, y, side in crops]
        drawn, places = self._renderer.draw_with_places(
            scene,
            windows,
            (self._size, self._size),
            PLACE_STRIDE,
            supersampling=1.0 if rng.random() < 0.15 else 1.5,
            sharpness=float(rng.uniform(-0.6, 0.3)),
        )
        camera = photography.random_camera(rng)
        images = np.stack(
            [
                photography.develop(
                    np.ascontiguousarray(picture[..., :3]), camera, rng, _within(shot, window, self._size)
                )
                for picture, shot, window in zip(drawn, scene.shots, windows, strict=True)
            ]
        )
        sizes = [(shot.width, shot.height) for shot in scene.shots]
        return RenderedScan(
            images=images,
            coverage=np.ascontiguousarray(drawn[..., 3]),
            crop_parameters=np.stack([crop_parameters(*c, *s) for c, s in zip(crops, sizes, strict=True)]),
            crops=np.array(crops),
            image_sizes=np.array(sizes),
            camera_from_object=np.stack([shot.camera_from_object for shot in scene.shots]),
            intrinsics=np.array([astuple(shot.intrinsics) for shot in scene.shots]),
            places=places,
            complete=np.array([shot.complete for shot in scene.shots]),
            symmetry=scene.thing.symmetry,
            motion=scene.motion,
            name=scene.thing.name,
        )


def _crop(rng: np.random.Generator, shot: Shot, style: ScanStyle) -> tuple[int, int, int]:
    """Left, top and side of a training crop around a detector's box (RelPose++, section 4)."""
    box = shot.box
    wrong = rng.normal(0, style.box_error, 4) * (box.width, box.height, box.width, box.height)
    x0, y0 = max(box.x0 + wrong[0], 0), max(box.y0 + wrong[1], 0)
    x1, y1 = min(box.x1 + wrong[2], shot.width), min(box.y1 + wrong[3], shot.height)
    seen = BoundingBox(x0, y0, max(x1, x0 + 8), max(y1, y0 + 8))
    shift = rng.uniform(-style.crop_shift, style.crop_shift, 2)
    return crop_square(seen, rng.uniform(*style.crop_scale), (float(shift[0]), float(shift[1])))


def _within(shot: Shot, window: Window, size: int) -> npt.NDArray[np.bool_] | None:
    """(size, size) where the crop shows the photograph; None where it does everywhere."""
    right, bottom = window.x0 + window.width, window.y0 + window.height
    if min(window.x0, window.y0) >= 0 and right <= shot.width and bottom <= shot.height:
        return None
    centre = (np.arange(size) + 0.5) / size
    x, y = window.x0 + centre * window.width, window.y0 + centre * window.height
    return np.asarray(((y >= 0) & (y < shot.height))[:, None] & ((x >= 0) & (x < shot.width))[None])
