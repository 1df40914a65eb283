"""From a view to what the network sees: a square crop, and where it lies in the full image.

To the letter of RelPose++: the box is made square on its longer side and enlarged about its centre, its
corners become integers, what lies outside the image is black, and the crop is resized bilinearly. Where the
object is segmented, the background and what lies outside are white instead, as for the checkpoint of masked
images.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.nn import functional

from relpose_ros.errors import RelPoseError

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.network.presets import Preset
    from relpose_ros.views import BoundingBox, View

    PixelArray = npt.NDArray[np.uint8]

BOX_SCALE = 1.15
"""How much larger than the box a crop is (training draws it from 1.1 to 1.2)."""
MAX_CROP_RATIO = 8
"""A crop this many times as large as its image is a mistake somewhere, and a great deal of memory."""
IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)
"""Of ImageNet, for RGB in 0..1."""


class CropError(RelPoseError):
    """No crop can be cut from a view."""


def crop_view(
    view: View, preset: Preset, scale: float = BOX_SCALE, shift: tuple[float, float] = (0.0, 0.0)
) -> tuple[torch.Tensor, torch.Tensor]:
    """The crop of a view, and its crop parameters.

    The picture may be the full image or a part of it: what the picture lacks of the crop counts as outside.

    Args:
        view: with its box in the full image.
        preset: says how large a crop is.
        scale: side of the crop in sides of the box.
        shift: of the crop's centre, right and down, in sides of the box (training jitters it).

    Returns:
        (3, S, S) float32, normalised; and (3,) float32, see `crop_parameters`.

    Raises:
        CropError: The box is empty, not finite, far too large, or beside the picture; the picture is no 8-bit
            RGB; or the mask is not boolean or has another size than the picture.
    """
    left, top, side = crop_square(view.box, scale, shift)
    if side > MAX_CROP_RATIO * max(view.full_width, view.full_height):
        image_size = f"{view.full_width} x {view.full_height}"
        raise CropError(f"The box {_words(view.box)} is far larger than its image of {image_size}.")
    pixels = _cut(view, left, top, side)
    image = torch.from_numpy(pixels).permute(2, 0, 1)[None].float().div_(255)
    size = (preset.image_size, preset.image_size)
    antialias = preset.crop_antialias and side > preset.image_size
    image = functional.interpolate(image, size, mode="bilinear", align_corners=False, antialias=antialias)
    mean, std = torch.tensor(IMAGE_MEAN)[:, None, None], torch.tensor(IMAGE_STD)[:, None, None]
    return (image[0] - mean) / std, crop_parameters(left, top, side, view.full_width, view.full_height)


def crop_square(
    box: BoundingBox, scale: float = BOX_SCALE, shift: tuple[float, float] = (0.0, 0.0)
) -> tuple[int, int, int]:
    """Left, top and side of the crop around a box, in whole pixels of the full image.

    Raises:
        CropError: The box is empty or not finite.
    """
    numbers = (box.x0, box.y0, box.x1, box.y1)
    if not (np.isfinite(numbers).all() and box.width > 0 and box.height > 0):
        raise CropError(f"The box {_words(box)} holds no pixel: x1 > x0 and y1 > y0 are needed.")
    side = max(box.width, box.height)
    half = side / 2 * scale
    left = round((box.x0 + box.x1) / 2 + shift[0] * side - half)
    top = round((box.y0 + box.y1) / 2 + shift[1] * side - half)
    return left, top, max(1, round(2 * half))


def crop_parameters(left: int, top: int, side: int, full_width: int, full_height: int) -> torch.Tensor:
    """Where a crop lies: its centre and its side, in halves of the image's shorter side. -> (3,) float32.

    The centre is in PyTorch3D's normalised coordinates: x left and y up from one such half right of and
    below the image's corner, so that a crop about the middle of a square image is at (0, 0).
    """
    half = min(full_width, full_height) / 2
    return torch.tensor(
        [1 - (left + side / 2) / half, 1 - (top + side / 2) / half, side / half], dtype=torch.float32
    )


def _cut(view: View, left: int, top: int, side: int) -> PixelArray:
    """(side, side, 3) pixels of the full image from (left, top) on, as far as the picture has them."""
    if view.image.dtype != np.uint8 or view.image.shape[2:] != (3,):
        raise CropError(
            f"The picture is {view.image.dtype} of shape {view.image.shape}; it must be 8-bit RGB (H, W, 3)."
        )
    height, width = view.image.shape[:2]
    if view.mask is not None and view.mask.dtype != np.bool_:
        raise CropError(f"The mask is {view.mask.dtype}; it must be boolean, True on the object.")
    if view.mask is not None and view.mask.shape != (height, width):
        raise CropError(
            f"The mask is {view.mask.shape[1]} x {view.mask.shape[0]}, its picture {width} x {height}; "
            "they must have the same size."
        )
    left, top = left - view.origin[0], top - view.origin[1]
    columns = slice(max(left, 0), min(left + side, width))
    rows = slice(max(top, 0), min(top + side, height))
    if columns.start >= columns.stop or rows.start >= rows.stop:
        raise CropError(
            f"The box {_words(view.box)} lies beside its picture, which shows {width} x {height} pixels "
            f"from {view.origin} on."
        )
    target = (slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left))
    crop = np.full((side, side, 3), 0 if view.mask is None else 255, np.uint8)
    crop[target] = view.image[rows, columns]
    if view.mask is not None:
        crop[target][~view.mask[rows, columns]] = 255
    return crop


def _words(box: BoundingBox) -> str:
    return f"({box.x0:g}, {box.y0:g}) to ({box.x1:g}, {box.y1:g})"
