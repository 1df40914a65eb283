from __future__ import annotations

import struct
import tracemalloc
import zlib
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.scanning.image_decoding import (
    ENCODINGS,
    ImageError,
    Region,
    compressed_size,
    decode_compressed,
    decode_image,
    decode_mask,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    Pixels = np.ndarray

BYTES_PER_PIXEL = {
    "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "mono16": 2, "8UC1": 1, "8UC3": 3, "8UC4": 4,
    "16UC1": 2, "bayer_rggb8": 1, "bayer_bggr8": 1, "bayer_gbrg8": 1, "bayer_grbg8": 1,
    "uyvy": 2, "yuv422": 2, "yuyv": 2, "yuv422_yuy2": 2, "nv21": 1, "nv24": 1,
}  # fmt: skip
ROWS_IN_ALL = {"nv21": 1.5, "nv24": 3}
"""Rows of step bytes per image row."""


def through_bgr(code: int, shape: tuple[int, ...]) -> Callable[[Pixels, int, int], Pixels]:
    """OpenCV's answer by way of BGR, which the code under test never takes."""

    def convert(rows: Pixels, width: int, height: int) -> Pixels:
        sizes = {"h": height, "w": width}
        pixels = rows.reshape([sizes.get(side, side) for side in shape])
        return cv2.cvtColor(pixels, code)[..., ::-1]

    return convert


def deep(rows: Pixels, width: int, height: int) -> Pixels:
    values = rows.reshape(-1).view(np.uint16).reshape(height, width)
    return cv2.cvtColor(cv2.convertScaleAbs(values, alpha=255 / 65535), cv2.COLOR_GRAY2BGR)


def nv21(rows: Pixels, width: int, height: int) -> Pixels:
    return cv2.cvtColor(rows.reshape(height * 3 // 2, width), cv2.COLOR_YUV2BGR_NV21)[..., ::-1]


def nv24(rows: Pixels, width: int, height: int) -> Pixels:
    """As nv12 of a picture twice as large, in which four luma samples share what one had."""
    luma = rows[:height].repeat(2, axis=0).repeat(2, axis=1)
    chroma = rows[height:].reshape(height, 2 * width)
    return cv2.cvtColor(np.concatenate([luma, chroma]), cv2.COLOR_YUV2BGR_NV12)[::2, ::2, ::-1]


# As cv_bridge maps them: OpenCV's old names tell the second row's second and third pixel.
OPENCV: dict[str, Callable[[Pixels, int, int], Pixels]] = {
    "rgb8": through_bgr(cv2.COLOR_RGB2BGR, ("h", "w", 3)),
    "bgr8": lambda rows, width, height: rows.reshape(height, width, 3)[..., ::-1],
    "8UC3": lambda rows, width, height: rows.reshape(height, width, 3)[..., ::-1],
    "rgba8": through_bgr(cv2.COLOR_RGBA2BGR, ("h", "w", 4)),
    "bgra8": through_bgr(cv2.COLOR_BGRA2BGR, ("h", "w", 4)),
    "8UC4": through_bgr(cv2.COLOR_BGRA2BGR, ("h", "w", 4)),
    "mono8": through_bgr(cv2.COLOR_GRAY2BGR, ("h", "w")),
    "8UC1": through_bgr(cv2.COLOR_GRAY2BGR, ("h", "w")),
    "mono16": deep,
    "16UC1": deep,
    "bayer_rggb8": through_bgr(cv2.COLOR_BayerBG2BGR, ("h", "w")),
    "bayer_bggr8": through_bgr(cv2.COLOR_BayerRG2BGR, ("h", "w")),
    "bayer_gbrg8": through_bgr(cv2.COLOR_BayerGR2BGR, ("h", "w")),
    "bayer_grbg8": through_bgr(cv2.COLOR_BayerGB2BGR, ("h", "w")),
    "uyvy": through_bgr(cv2.COLOR_YUV2BGR_UYVY, ("h", "w", 2)),
    "yuv422": through_bgr(cv2.COLOR_YUV2BGR_UYVY, ("h", "w", 2)),
    "yuyv": through_bgr(cv2.COLOR_YUV2BGR_YUY2, ("h", "w", 2)),
    "yuv422_yuy2": through_bgr(cv2.COLOR_YUV2BGR_YUY2, ("h", "w", 2)),
    "nv21": nv21,
    "nv24": nv24,
}


def random_rows(encoding: str, width: int, height: int, seed: int = 0) -> Pixels:
    rows = int(height * ROWS_IN_ALL.get(encoding, 1))
    return np.random.default_rng(seed).integers(
        0, 256, (rows, width * BYTES_PER_PIXEL[encoding]), np.uint8
    )  # fmt: skip


def padded(encoding: str, rows: Pixels, height: int, padding: int) -> tuple[Pixels, int]:
    """The rows with garbage behind each, as a driver that aligns its rows sends them, and their step."""
    step = rows.shape[1] + padding
    filler = np.random.default_rng(1)
    if encoding == "nv24":
        # A chroma row is twice as long as a luma row, and so is its padding.
        luma, chroma = rows[:height], rows[height:].reshape(height, -1)
        parts = [(luma, step), (chroma, 2 * step)]
    else:
        parts = [(rows, step)]
    out = []
    for part, length in parts:
        block = filler.integers(0, 256, (len(part), length), np.uint8)
        block[:, : part.shape[1]] = part
        out.append(block.reshape(-1))
    return np.concatenate(out), step


def test_the_table_names_every_encoding() -> None:
    assert set(ENCODINGS) == set(OPENCV)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", sorted(OPENCV))
def test_every_encoding_reads_as_opencv_reads_it(messages: Any, encoding: str, padding: int) -> None:
    width, height = 22, 14
    rows = random_rows(encoding, width, height)
    data, step = padded(encoding, rows, height, padding)
    message = messages.image(data.tobytes(), width, height, encoding, step)
    np.testing.assert_array_equal(decode_image(message), OPENCV[encoding](rows, width, height))


@pytest.mark.parametrize("encoding", sorted({"rgb8", "bayer_rggb8", "bayer_gbrg8", "mono16", "nv24"}))
def test_odd_sizes_are_read_where_the_encoding_allows_them(bag_messages: Any, encoding: str) -> None:
    rows = random_rows(encoding, 13, 11)
    message = bag_messages.image(rows.tobytes(), 13, 11, encoding, rows.shape[1])
    np.testing.assert_array_equal(decode_image(message), OPENCV[encoding](rows, 13, 11))


@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_the_order_of_bytes_is_honoured(messages: Any, encoding: str) -> None:
    values = np.array([[0, 255, 256, 65535, 32768, 128, 129, 385]], np.uint16).repeat(4, axis=0)
    expected = np.round(values / 257).astype(np.uint8)
    for order, flag in (("<u2", 0), (">u2", 1)):
        message = messages.image(values.astype(order).tobytes(), 8, 4, encoding, 16, is_bigendian=flag)
        np.testing.assert_array_equal(decode_image(message)[..., 1], expected)


def bayer_of(colour: tuple[int, int, int], pattern: str) -> Pixels:
    tile = np.array([colour["rgb".index(letter)] for letter in pattern], np.uint8).reshape(2, 2)
    return np.tile(tile, (8, 8))


@pytest.mark.parametrize("colour", [(250, 10, 20), (10, 250, 20), (10, 20, 250)])
@pytest.mark.parametrize("encoding", sorted(set(OPENCV) - {"mono8", "mono16", "8UC1", "16UC1"}))
def test_a_red_wall_is_red(bag_messages: Any, encoding: str, colour: tuple[int, int, int]) -> None:
    """Built from what the encodings' names mean, without OpenCV's own names for them."""
    red, green, blue = (float(each) for each in colour)
    # ITU-R BT.601, limited range.
    y = round(16 + (65.481 * red + 128.553 * green + 24.966 * blue) / 255)
    u = round(128 + (-37.797 * red - 74.203 * green + 112 * blue) / 255)
    v = round(128 + (112 * red - 93.786 * green - 18.214 * blue) / 255)
    wall: Any
    if encoding.startswith("bayer_"):
        wall = bayer_of(colour, encoding[6:10])
    elif encoding == "nv21":
        wall = np.concatenate([np.full((16, 16), y), np.tile([v, u], (8, 8))])
    elif encoding == "nv24":
        wall = np.concatenate([np.full(256, y), np.tile([u, v], 256)]).reshape(48, 16)
    elif encoding in {"uyvy", "yuv422"}:
        wall = np.tile([u, y, v, y], (16, 8))
    elif encoding in {"yuyv", "yuv422_yuy2"}:
        wall = np.tile([y, u, y, v], (16, 8))
    elif encoding in {"rgb8", "rgba8"}:
        wall = np.tile([*colour, 77][: BYTES_PER_PIXEL[encoding]], (16, 16))
    else:
        wall = np.tile([*colour[::-1], 77][: BYTES_PER_PIXEL[encoding]], (16, 16))
    message = bag_messages.image(
        np.asarray(wall, np.uint8).tobytes(), 16, 16, encoding, 16 * BYTES_PER_PIXEL[encoding]
    )
    difference = np.abs(decode_image(message).astype(int) - colour)
    assert difference.max() <= 3, "rounding of YUV"


@settings(max_examples=150)
@given(data=st.data())
def test_a_region_is_what_the_whole_picture_has_there(bag_messages: Any, data: st.DataObject) -> None:
    encoding = data.draw(st.sampled_from(sorted(OPENCV)))
    width, height = (2 * data.draw(st.integers(4, 20)) for _ in range(2))
    if encoding.startswith(("rgb", "bgr", "mono", "bayer", "nv24")):
        width, height = width + data.draw(st.integers(0, 1)), height + data.draw(st.integers(0, 1))
    x0, y0 = data.draw(st.integers(0, width - 1)), data.draw(st.integers(0, height - 1))
    x1, y1 = data.draw(st.integers(x0 + 1, width)), data.draw(st.integers(y0 + 1, height))
    rows = random_rows(encoding, width, height, seed=width * height)
    block, step = padded(encoding, rows, height, data.draw(st.integers(0, 3)))
    message = bag_messages.image(block.tobytes(), width, height, encoding, step)
    part = decode_image(message, Region(x0, y0, x1, y1))
    np.testing.assert_array_equal(part, decode_image(message)[y0:y1, x0:x1])


@pytest.mark.parametrize("encoding", sorted(OPENCV))
def test_the_pixels_are_a_writable_copy(bag_messages: Any, encoding: str) -> None:
    rows = random_rows(encoding, 16, 16)
    message = bag_messages.image(rows.tobytes(), 16, 16, encoding, rows.shape[1])
    pixels = decode_image(message)
    assert pixels.flags.c_contiguous
    assert pixels.flags.writeable
    assert not np.shares_memory(pixels, message.data)


@pytest.mark.parametrize("encoding", sorted(OPENCV))
def test_only_the_region_is_copied(messages: Any, encoding: str) -> None:
    width, height, side = 1920, 1080, 120
    rows = np.zeros((int(height * ROWS_IN_ALL.get(encoding, 1)), width * BYTES_PER_PIXEL[encoding]), np.uint8)
    message = messages.image(rows.tobytes(), width, height, encoding, rows.shape[1])
    tracemalloc.start()
    decode_image(message, Region(901, 301, 901 + side, 301 + side))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20 * side * side, "bytes: a copy of the whole image is two million and more"


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"encoding": "32FC1"}, "the encoding '32FC1' is not read: send one of rgb8, bgr8,"),
        ({"encoding": ""}, "the encoding '' is not read"),
        ({"encoding": "x" * 4000}, r"'x{35}\.\.\. is not read"),
        ({"width": 0}, "has no pixels: 0 x 16"),
        ({"height": 0}, "has no pixels: 16 x 0"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "more than the 67108864"),
        ({"step": 47}, "step is 47, but a row of 16 rgb8 pixels takes 48 bytes"),
        ({"step": 0}, "step is 0"),
        ({"step": 2**32 - 1}, "cut off: 768 bytes, but 16 rows of step 4294967295 take 68719476720"),
        ({"height": 17}, "cut off: 768 bytes, but 17 rows of step 48 take 816"),
        ({"data": b""}, "cut off: 0 bytes"),
        ({"encoding": "uyvy", "width": 15}, "15 x 16 pixels cannot be uyvy"),
        ({"encoding": "yuv422_yuy2", "width": 15}, "15 x 16 pixels cannot be yuv422_yuy2"),
        ({"encoding": "nv21", "width": 15}, "15 x 16 pixels cannot be nv21"),
        ({"encoding": "nv21", "height": 15}, "16 x 15 pixels cannot be nv21"),
        ({"encoding": "nv21", "step": 33}, "cut off: 768 bytes, but 16 rows of step 33 take 792"),
        ({"encoding": "nv24", "step": 17}, "cut off: 768 bytes, but 16 rows of step 17 take 816"),
    ],
)
def test_what_contradicts_itself_is_rejected(messages: Any, fields: dict[str, Any], said: str) -> None:
    good = {"data": bytes(768), "width": 16, "height": 16, "encoding": "rgb8", "step": 48}
    with pytest.raises(ImageError, match=said):
        decode_image(messages.image(**(good | fields)))


def test_bayer_pixels_too_few_to_interpolate_are_rejected_or_read(bag_messages: Any) -> None:
    for width in range(1, 5):
        message = bag_messages.image(bytes(width), width, 1, "bayer_rggb8", width)
        with suppress(ImageError):
            assert decode_image(message).shape == (1, width, 3)


def test_a_mask_is_true_off_zero(messages: Any) -> None:
    mask = np.zeros((16, 16), np.uint8)
    mask[4:8, 5:9] = [1, 128, 254, 255]
    message = messages.image(mask.tobytes(), 16, 16, "mono8", 16)
    np.testing.assert_array_equal(decode_mask(message), mask > 0)
    np.testing.assert_array_equal(decode_mask(message, Region(4, 4, 9, 9)), mask[4:9, 4:9] > 0)
    with pytest.raises(ImageError, match="the mask's encoding is 'rgb8': send mono8"):
        decode_mask(messages.image(bytes(768), 16, 16, "rgb8", 48))
    with pytest.raises(ImageError, match="the mask: the data are cut off"):
        decode_mask(messages.image(bytes(255), 16, 16, "mono8", 16))


def photo(width: int = 48, height: int = 32) -> Pixels:
    """Smooth colours, so that JPEG keeps them."""
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return np.stack([x, y, 255 - x], -1).astype(np.uint8)


def encoded(kind: str, pixels: Pixels) -> bytes:
    return cv2.imencode(kind, pixels)[1].tobytes()


@pytest.mark.parametrize("kind", [".jpg", ".png"])
def test_compressed_images_read_as_opencv_reads_them(messages: Any, kind: str) -> None:
    data = encoded(kind, photo())
    message = messages.compressed(data, "rgb8; jpeg compressed bgr8")
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert compressed_size(message) == (48, 32)
    np.testing.assert_array_equal(decode_compressed(message), expected)
    np.testing.assert_array_equal(
        decode_compressed(message, Region(3, 5, 20, 30)), expected[5:30, 3:20]
    )  # fmt: skip


@pytest.mark.parametrize("flags", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 1]])
def test_jpegs_of_every_make_are_read(bag_messages: Any, flags: list[int]) -> None:
    data = cv2.imencode(".jpg", photo(), flags)[1].tobytes()
    assert decode_compressed(bag_messages.compressed(data)).shape == (32, 48, 3)
    # Fill bytes before a marker (ITU-T T.81, B.1.1.2), and what cameras append.
    assert decode_compressed(bag_messages.compressed(data[:2] + b"\xff\xff" + data[2:])).shape == (32, 48, 3)
    for appended in (bytes(4096), b"SEFT" * 64):
        assert decode_compressed(bag_messages.compressed(data + appended)).shape == (32, 48, 3)


@pytest.mark.parametrize(
    "pixels",
    [photo()[..., 0], np.dstack([photo(), photo()[..., :1]]), photo().astype(np.uint16) * 257],
    ids=["grey", "alpha", "16 bit"],
)
def test_a_png_of_another_depth_becomes_rgb(bag_messages: Any, pixels: Pixels) -> None:
    decoded = decode_compressed(bag_messages.compressed(encoded(".png", pixels), "png"))
    expected = pixels if pixels.ndim == 2 else pixels[..., 2]
    np.testing.assert_array_equal(decoded[..., 0], expected // (257 if pixels.dtype == np.uint16 else 1))


def test_an_orientation_tag_does_not_turn_the_picture(bag_messages: Any) -> None:
    data = encoded(".jpg", photo())
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
    exif = b"Exif\0\0" + tiff
    tagged = data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    turned = cv2.imdecode(np.frombuffer(tagged, np.uint8), cv2.IMREAD_COLOR)
    assert turned.shape == (48, 32, 3), "OpenCV by itself follows the tag"
    np.testing.assert_array_equal(
        decode_compressed(bag_messages.compressed(tagged)), decode_compressed(bag_messages.compressed(data))
    )


@pytest.mark.parametrize("kind", [".jpg", ".png"])
def test_a_compressed_image_cut_off_anywhere_is_rejected(bag_messages: Any, kind: str) -> None:
    data = encoded(kind, photo())
    end = len(data) - (1 if kind == ".jpg" else 8)
    for length in range(0, end, 7):
        with pytest.raises(ImageError):
            decode_compressed(bag_messages.compressed(data[:length]))
    assert decode_compressed(bag_messages.compressed(data)).any()


def test_a_thumbnail_does_not_pass_for_the_end_of_a_picture(bag_messages: Any) -> None:
    thumbnail = encoded(".jpg", photo(16, 16))
    data = encoded(".jpg", photo())
    with_thumbnail = data[:2] + b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail + data[2:]
    assert compressed_size(bag_messages.compressed(with_thumbnail)) == (48, 32)
    assert decode_compressed(bag_messages.compressed(with_thumbnail)).shape == (32, 48, 3)
    with pytest.raises(ImageError, match="without an end marker"):
        decode_compressed(bag_messages.compressed(with_thumbnail[:-40]))


def test_a_table_before_the_frame_header_is_not_taken_for_it(bag_messages: Any) -> None:
    """Its marker lies among those of frame headers; cameras may send it first."""
    data = encoded(".jpg", photo())
    frame, table = data.index(b"\xff\xc0"), data.index(b"\xff\xc4")
    end = table + 2 + int.from_bytes(data[table + 2 : table + 4], "big")
    first = bag_messages.compressed(data[:frame] + data[table:end] + data[frame:table] + data[end:])
    assert compressed_size(first) == (48, 32)
    np.testing.assert_array_equal(decode_compressed(first), decode_compressed(bag_messages.compressed(data)))


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def test_a_decompression_bomb_is_not_decoded(bag_messages: Any) -> None:
    side = 50_000
    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    pixels = png_chunk(b"IDAT", zlib.compress(bytes(100_000)))
    bomb = b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header) + pixels + png_chunk(b"IEND", b"")
    with pytest.raises(ImageError, match="50000 x 50000 pixels are more than the 67108864"):
        decode_compressed(bag_messages.compressed(bomb))
    jpeg = bytearray(encoded(".jpg", photo()))
    frame = jpeg.index(b"\xff\xc0")
    jpeg[frame + 5 : frame + 9] = b"\xff\xff\xff\xff"
    with pytest.raises(ImageError, match="65535 x 65535 pixels are more"):
        decode_compressed(bag_messages.compressed(bytes(jpeg)))


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", r"the 0 compressed bytes \(format '16UC1; compressedDepth'\) are neither JPEG nor PNG"),
        (bytes(12) + encoded(".png", photo()), "neither JPEG nor PNG"),
        (encoded(".bmp", photo()), "neither JPEG nor PNG"),
        (encoded(".webp", photo()), "neither JPEG nor PNG"),
        (b"\xff\xd8\xff\xd9", "header is broken"),
        (b"\xff\xd8" + b"\xff\xe0\0\0" * 50, "header is broken"),
        (b"\xff\xd8\xff\xc0\0\x11\x08\0\0\0\0\x03", "no pixels: 0 x 0"),
        (b"\xff\xd8\xff\xc0\0\x11\x08\0\x10\0\x10\x03\xff\xd9", "do not decode"),
        (b"\x89PNG\r\n\x1a\n" + bytes(40), "neither JPEG nor PNG"),
    ],
)
def test_what_is_no_picture_is_rejected(messages: Any, data: bytes, said: str) -> None:
    with pytest.raises(ImageError, match=said):
        decode_compressed(messages.compressed(data, "16UC1; compressedDepth"))


@settings(max_examples=300)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.sampled_from([".jpg", ".png"]))
def test_flipped_bytes_are_rejected_or_read_but_never_more(
    bag_messages: Any, seed: int, flips: int, kind: str
) -> None:
    data = np.frombuffer(encoded(kind, photo()), np.uint8).copy()
    random = np.random.default_rng(seed)
    data[random.integers(2, len(data), flips)] = random.integers(0, 256, flips)
    message = bag_messages.compressed(data.tobytes())
    with suppress(ImageError):
        width, height = compressed_size(message)
        assert decode_compressed(message).shape == (height, width, 3)
