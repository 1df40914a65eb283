"""Pixels of sensor_msgs/Image and sensor_msgs/CompressedImage as RGB.

A raw image is decoded only where it is asked for: a box usually covers a small part of a frame, and copying
the rest would keep the callback busy for nothing.

Encodings are those of ``sensor_msgs/image_encodings``. Conventions where that list leaves a choice:

- 8UC3 and 8UC4 say nothing about colour; they are read as BGR and BGRA, as OpenCV writes them.
- mono16 and 16UC1 are scaled by 255 / 65535 and rounded, as cv_bridge scales mono16.
- YUV is ITU-R BT.601 with limited range, as in OpenCV.
- nv21 is a plane of luma rows of ``step`` bytes, and below it half as many rows of V and U in turn, ``step``
  bytes each; nv24 has below its luma as many rows of U and V in turn, 2 ``step`` bytes each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from relpose_ros.errors import RelPoseError

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    Pixels = npt.NDArray[np.uint8]

MAX_PIXELS = 2**26
"""Largest picture, pixels (8192 x 8192). A larger one is a broken header or a decompression bomb."""

_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_PNG_SIGNATURE, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"


class ImageError(RelPoseError):
    """A picture that cannot be decoded."""


@dataclass(frozen=True)
class Region:
    """A part of a picture: columns x0 to x1 and rows y0 to y1, the last ones excluded."""

    x0: int
    y0: int
    x1: int
    y1: int


def raw_size(message: Any) -> tuple[int, int]:
    """Width and height of a sensor_msgs/Image, pixels.

    Raises:
        ImageError: It has no pixels, or more than anyone's camera.
    """
    return _checked_size(int(message.width), int(message.height))


def decode_image(message: Any, region: Region | None = None) -> Pixels:
    """A part of a sensor_msgs/Image as RGB.

    Args:
        message: The message.
        region: Which part, inside the picture; None for the whole of it.

    Returns:
        (H, W, 3), a copy.

    Raises:
        ImageError: The encoding is not read, or header and data contradict each other.
    """
    width, height = raw_size(message)
    layout = _LAYOUTS.get(message.encoding)
    if layout is None:
        text = f"the encoding {_shown(message.encoding)} is not read: send one of {', '.join(_LAYOUTS)}"
        raise ImageError(text)
    if width % layout.even_width or height % layout.even_height:
        text = (
            f"{width} x {height} pixels cannot be {message.encoding}, whose colours are shared by neighbours"
        )
        raise ImageError(text)
    step, row = int(message.step), width * layout.bytes_per_pixel
    if step < row:
        text = f"step is {step}, but a row of {width} {message.encoding} pixels takes {row} bytes"
        raise ImageError(text)
    data = _bytes(message.data)
    needed = step * (height + height * layout.chroma_steps_twice // 2)
    if data.size < needed:
        text = f"the data are cut off: {data.size} bytes, but {height} rows of step {step} take {needed}"
        raise ImageError(text)
    wanted = Region(0, 0, width, height) if region is None else region
    grown = _grown(wanted, layout.margin, width, height)
    raw = _Raw(data, step, height, bool(message.is_bigendian))
    try:
        pixels = layout.decode(raw, grown)
    except cv2.error as err:
        raise ImageError(
            f"{width} x {height} {message.encoding} pixels cannot be converted: {err.err}"
        ) from err
    return np.ascontiguousarray(
        pixels[wanted.y0 - grown.y0 : wanted.y1 - grown.y0, wanted.x0 - grown.x0 : wanted.x1 - grown.x0]
    )


def decode_mask(message: Any, region: Region | None = None) -> npt.NDArray[np.bool_]:
    """A part of a mask, mono8 or 8UC1, (H, W): True where it is not zero.

    Raises:
        ImageError: It has another encoding, or header and data contradict each other.
    """
    if message.encoding not in {"mono8", "8UC1"}:
        raise ImageError(f"the mask's encoding is {_shown(message.encoding)}: send mono8")
    try:
        return np.asarray(decode_image(message, region)[..., 0] > 0)
    except ImageError as err:
        raise ImageError(f"the mask: {err}") from err


def compressed_size(message: Any) -> tuple[int, int]:
    """Width and height of a sensor_msgs/CompressedImage as its header states them, pixels.

    Raises:
        ImageError: It is no JPEG or PNG, its header is broken, or it has more pixels than anyone's camera.
    """
    return _compressed_header(_bytes(message.data).tobytes(), message.format)[:2]


def compressed_format(data: bytes) -> str | None:
    """What ``format`` of a sensor_msgs/CompressedImage says of such data: jpeg or png; None: neither."""
    if data.startswith(_PNG_SIGNATURE):
        return "png"
    return "jpeg" if data.startswith(_JPEG_START) else None


def decode_compressed(message: Any, region: Region | None = None) -> Pixels:
    """A part of a JPEG or PNG in a sensor_msgs/CompressedImage as RGB.

    The pixels are those stored: an orientation tag is not applied, since the camera's box and intrinsics
    know nothing of it. More than 8 bits a channel are reduced to 8.

    Args:
        message: The message.
        region: Which part, inside the picture; None for the whole of it.

    Returns:
        (H, W, 3), a copy.

    Raises:
        ImageError: See `compressed_size`; or the data are cut off or do not decode.
    """
    data = _bytes(message.data)
    encoded = data.tobytes()
    # The header is read first: decoding a few kilobytes can fill the memory.
    width, height, frame = _compressed_header(encoded, message.format)
    # OpenCV would fill in grey. Cameras may append what they like, and a thumbnail before has its own end.
    if encoded.find(_PNG_END if encoded.startswith(_PNG_SIGNATURE) else _JPEG_END, frame) < 0:
        raise ImageError(f"the compressed data are cut off: {data.size} bytes without an end marker")
    try:
        bgr = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as err:
        raise ImageError(f"the {data.size} compressed bytes do not decode: {err.err}") from err
    if bgr is None or bgr.shape != (height, width, 3):
        raise ImageError(f"the {data.size} compressed bytes do not decode to {width} x {height} pixels")
    wanted = Region(0, 0, width, height) if region is None else region
    part = np.ascontiguousarray(bgr[wanted.y0 : wanted.y1, wanted.x0 : wanted.x1])
    return np.asarray(cv2.cvtColor(part, cv2.COLOR_BGR2RGB), np.uint8)


@dataclass(frozen=True)
class _Raw:
    data: Pixels
    step: int
    height: int
    big_endian: bool

    def block(self, region: Region, bytes_per_pixel: int) -> Pixels:
        """The region's bytes, (rows, columns * bytes_per_pixel): a copy of nothing else."""
        rows = self.data[: self.step * self.height].reshape(self.height, self.step)
        columns = slice(region.x0 * bytes_per_pixel, region.x1 * bytes_per_pixel)
        block: Pixels = rows[region.y0 : region.y1, columns].copy()
        return block


@dataclass(frozen=True)
class _Layout:
    decode: Callable[[_Raw, Region], Pixels]
    bytes_per_pixel: int
    """Of a row of ``step`` bytes."""
    margin: int = 0
    """Pixels around a region that its own pixels depend on; if not zero, it begins at even pixels too."""
    even_width: int = 1
    even_height: int = 1
    """2 where the width or height must be even."""
    chroma_steps_twice: int = 0
    """Twice the bytes below the luma rows, in units of ``step * height``."""


def _packed(raw: _Raw, region: Region, channels: int, conversion: int | None) -> Pixels:
    block = raw.block(region, channels)
    pixels = block.reshape(block.shape[0], -1, channels)
    return pixels if conversion is None else _converted(pixels, conversion)


def _deep(raw: _Raw, region: Region) -> Pixels:
    values = raw.block(region, 2).view(">u2" if raw.big_endian else "<u2").astype(np.uint16)
    return _converted(
        np.asarray(cv2.convertScaleAbs(values, alpha=255 / 65535), np.uint8), cv2.COLOR_GRAY2RGB
    )


def _nv21(raw: _Raw, region: Region) -> Pixels:
    chroma = _Raw(raw.data[raw.step * raw.height :], raw.step, raw.height // 2, raw.big_endian)
    below = chroma.block(Region(region.x0, region.y0 // 2, region.x1, region.y1 // 2), 1)
    return _converted(np.concatenate([raw.block(region, 1), below]), cv2.COLOR_YUV2RGB_NV21)


def _nv24(raw: _Raw, region: Region) -> Pixels:
    chroma = _Raw(raw.data[raw.step * raw.height :], 2 * raw.step, raw.height, raw.big_endian)
    luma = raw.block(region, 1)
    u, v = cv2.split(chroma.block(region, 2).reshape(*luma.shape, 2))
    # OpenCV has no nv24; as uyvy with every luma sample twice it is the same colours at twice the width.
    uyvy = cv2.merge([u, luma, v, luma]).reshape(luma.shape[0], -1, 2)
    return _converted(np.asarray(uyvy, np.uint8), cv2.COLOR_YUV2RGB_UYVY)[:, ::2]


def _converted(pixels: Pixels, conversion: int) -> Pixels:
    return np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)


def _packed_layout(channels: int, conversion: int | None, margin: int = 0, even_width: int = 1) -> _Layout:
    decode = partial(_packed, channels=channels, conversion=conversion)
    return _Layout(decode, channels, margin, even_width)


_LAYOUTS = {
    "rgb8": _packed_layout(3, None),
    "bgr8": _packed_layout(3, cv2.COLOR_BGR2RGB),
    "rgba8": _packed_layout(4, cv2.COLOR_RGBA2RGB),
    "bgra8": _packed_layout(4, cv2.COLOR_BGRA2RGB),
    "mono8": _packed_layout(1, cv2.COLOR_GRAY2RGB),
    "mono16": _Layout(_deep, 2),
    "8UC1": _packed_layout(1, cv2.COLOR_GRAY2RGB),
    "8UC3": _packed_layout(3, cv2.COLOR_BGR2RGB),
    "8UC4": _packed_layout(4, cv2.COLOR_BGRA2RGB),
    "16UC1": _Layout(_deep, 2),
    # A pixel's colours are interpolated from its neighbours, and OpenCV copies the outermost rows and
    # columns from the next ones inside.
    "bayer_rggb8": _packed_layout(1, cv2.COLOR_BayerRGGB2RGB, margin=2),
    "bayer_bggr8": _packed_layout(1, cv2.COLOR_BayerBGGR2RGB, margin=2),
    "bayer_gbrg8": _packed_layout(1, cv2.COLOR_BayerGBRG2RGB, margin=2),
    "bayer_grbg8": _packed_layout(1, cv2.COLOR_BayerGRBG2RGB, margin=2),
    "uyvy": _packed_layout(2, cv2.COLOR_YUV2RGB_UYVY, margin=2, even_width=2),
    "yuv422": _packed_layout(2, cv2.COLOR_YUV2RGB_UYVY, margin=2, even_width=2),
    "yuyv": _packed_layout(2, cv2.COLOR_YUV2RGB_YUYV, margin=2, even_width=2),
    "yuv422_yuy2": _packed_layout(2, cv2.COLOR_YUV2RGB_YUYV, margin=2, even_width=2),
    "nv21": _Layout(_nv21, 1, margin=2, even_width=2, even_height=2, chroma_steps_twice=1),
    "nv24": _Layout(_nv24, 1, chroma_steps_twice=4),
}

ENCODINGS = tuple(_LAYOUTS)
"""The encodings that are read."""


def _grown(region: Region, margin: int, width: int, height: int) -> Region:
    if margin == 0:
        return region
    x0, y0 = max(region.x0 - margin, 0) // 2 * 2, max(region.y0 - margin, 0) // 2 * 2
    x1, y1 = (region.x1 + margin + 1) // 2 * 2, (region.y1 + margin + 1) // 2 * 2
    return Region(x0, y0, min(x1, width), min(y1, height))


def _bytes(data: Any) -> Pixels:
    """A message's data, whatever holds them, without a copy."""
    return np.frombuffer(data, np.uint8) if len(data) else np.zeros(0, np.uint8)


def _checked_size(width: int, height: int) -> tuple[int, int]:
    if width <= 0 or height <= 0:
        raise ImageError(f"the picture has no pixels: {width} x {height}")
    if width * height > MAX_PIXELS:
        raise ImageError(f"{width} x {height} pixels are more than the {MAX_PIXELS} a picture may have")
    return width, height


def _compressed_header(data: bytes, stated_format: Any) -> tuple[int, int, int]:
    """Width, height and where they stand, of a PNG (ISO/IEC 15948) or a JPEG (ITU-T T.81, annex B)."""
    if data.startswith(_PNG_SIGNATURE) and data[12:16] == b"IHDR" and len(data) >= 24:
        width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
        return *_checked_size(width, height), 16
    if not data.startswith(_JPEG_START):
        text = f"the {len(data)} compressed bytes (format {_shown(stated_format)}) are neither JPEG nor PNG"
        raise ImageError(text)
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # a fill byte
            position += 1
        elif 0xC0 <= marker <= 0xCF and marker not in {0xC4, 0xC8, 0xCC}:
            height = int.from_bytes(data[position + 5 : position + 7], "big")
            width = int.from_bytes(data[position + 7 : position + 9], "big")
            return *_checked_size(width, height), position
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    raise ImageError(f"the JPEG's header is broken: {len(data)} bytes without a frame size")


def _shown(value: Any) -> str:
    """A value for a sentence: garbage can be long."""
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:36]}..."
