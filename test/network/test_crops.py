"""Crops: by hand, against a pixel-by-pixel resize, and unchanged by how much of the image arrived."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.network import crops
from relpose_ros.network.presets import PRESETS
from relpose_ros.views import BoundingBox, View

PAPER = PRESETS["paper"]
SMALL = replace(PAPER, image_size=32)


def picture(width: int, height: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def view(box: BoundingBox, width: int = 200, height: int = 150, seed: int = 0) -> View:
    return View(picture(width, height, seed), box, width, height)


def plain(image: torch.Tensor) -> np.ndarray:
    """A normalised crop as (S, S, 3) in 0..255."""
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    return (image.permute(1, 2, 0).double().numpy() * std + mean) * 255


def resized(pixels: np.ndarray, size: int) -> np.ndarray:
    """Bilinear between pixel centres, edge pixels repeated beyond them, one axis after the other."""
    for axis in (0, 1):
        count = pixels.shape[axis]
        place = np.clip((np.arange(size) + 0.5) * count / size - 0.5, 0, count - 1)
        low = np.floor(place).astype(int)
        share = (place - low).reshape([-1 if k == axis else 1 for k in range(3)])
        upper = np.take(pixels, np.minimum(low + 1, count - 1), axis)
        pixels = np.take(pixels, low, axis) * (1 - share) + upper * share
    return pixels


boxes = st.tuples(st.floats(-60, 190), st.floats(-60, 140), st.floats(4, 220), st.floats(4, 220)).map(
    lambda b: BoundingBox(b[0], b[1], b[0] + b[2], b[1] + b[3])
)


def overlaps(box: BoundingBox) -> bool:
    left, top, side = crops.crop_square(box)
    return left < 200 and top < 150 and left + side > 0 and top + side > 0


def test_a_square_by_hand() -> None:
    # Longer side 100, enlarged to 115 about (70, 90); 50 times 1.15 is a little less than 57.5 in binary.
    assert crops.crop_square(BoundingBox(20, 60, 120, 120)) == (13, 33, 115)
    assert crops.crop_square(BoundingBox(20, 60, 120, 120), scale=1.0) == (20, 40, 100)
    assert crops.crop_square(BoundingBox(20, 60, 120, 120), scale=1.0, shift=(0.07, -0.05)) == (27, 35, 100)
    assert crops.crop_square(BoundingBox(0, 0, 10, 40), scale=1.25) == (-20, -5, 50)
    assert crops.crop_square(BoundingBox(0, 0, 0.1, 0.1)) == (0, 0, 1)


def test_half_pixels_go_to_the_even_neighbour() -> None:
    assert crops.crop_square(BoundingBox(0.5, 1.5, 10.5, 11.5), scale=1.0) == (0, 2, 10)
    assert crops.crop_square(BoundingBox(0, 0, 4.5, 4.5), scale=1.0) == (0, 0, 4)


def test_crop_parameters_by_hand() -> None:
    # Centre (70, 90) of side 115 in 200 x 150: in half short sides of 75, from their corner, turned over.
    parameters = crops.crop_parameters(70 - 57, 90 - 57, 114, 200, 150)
    assert parameters.tolist() == pytest.approx([-(70 / 75 - 1), -(90 / 75 - 1), 114 / 75])
    assert crops.crop_parameters(0, 0, 100, 100, 100).tolist() == [0, 0, 2]


def by_the_description(view: View, size: int) -> tuple[np.ndarray, list[float]] | None:
    """Crop (S, S, 3) in 0..255 and crop parameters as the method is described, with nothing of ours.

    The box made square on its longer side, scaled by 1.15 about its centre, integer corners, black outside
    (white beside a mask), bilinear. None for a square that shows nothing of the picture.
    """
    corners = np.array([[view.box.x0, view.box.y0], [view.box.x1, view.box.y1]])
    centre, half = corners.mean(0), (corners[1] - corners[0]).max() / 2 * 1.15
    first = np.round(centre - half).astype(int)
    last = first + np.round(2 * half).astype(int)
    x, y = (np.arange(first[axis], last[axis]) - view.origin[axis] for axis in (0, 1))
    height, width = view.image.shape[:2]
    known = ((y >= 0) & (y < height))[:, None] & ((x >= 0) & (x < width))
    if not known.any():
        return None
    rows, columns = np.clip(y, 0, height - 1)[:, None], np.clip(x, 0, width - 1)
    if view.mask is not None:
        known &= view.mask[rows, columns]
    outside = 0.0 if view.mask is None else 255.0
    crop = np.where(known[..., None], view.image[rows, columns].astype(float), outside)
    shorter = min(view.full_width, view.full_height)
    (cx, cy), side = (first + last) / 2, last[0] - first[0]
    parameters = [-(2 * cx / shorter - 1), -(2 * cy / shorter - 1), 2 * side / shorter]
    return resized(crop, size), parameters


odd_boxes = st.tuples(st.floats(-90, 230), st.floats(-90, 180), st.floats(0.5, 300), st.floats(0.5, 300)).map(
    lambda b: BoundingBox(b[0], b[1], b[0] + b[2], b[1] + b[3])
)


@settings(max_examples=150)
@given(
    odd_boxes
    | odd_boxes.map(lambda b: BoundingBox(*(float(round(e)) for e in (b.x0, b.y0, b.x1 + 1, b.y1 + 1)))),
    st.sampled_from(["whole", "cut", "cut to the box"]),
    st.booleans(),
)
def test_to_the_letter_of_the_description(box: BoundingBox, arrives: str, masked: bool) -> None:
    given_view = view(box)
    if masked:
        given_view = replace(given_view, mask=np.random.default_rng(1).random((150, 200)) < 0.7)
    if arrives != "whole":
        edges = (20, 10, 170, 140) if arrives == "cut" else (box.x0, box.y0, box.x1, box.y1)
        x0, y0 = (int(np.clip(edge, 0, limit)) for edge, limit in zip(edges[:2], (199, 149), strict=True))
        x1, y1 = max(x0 + 1, int(min(edges[2], 200))), max(y0 + 1, int(min(edges[3], 150)))
        mask = None if given_view.mask is None else given_view.mask[y0:y1, x0:x1]
        given_view = replace(given_view, image=given_view.image[y0:y1, x0:x1], origin=(x0, y0), mask=mask)
    expected = by_the_description(given_view, SMALL.image_size)
    if expected is None:
        with pytest.raises(crops.CropError, match="lies beside its picture"):
            crops.crop_view(given_view, SMALL)
        return
    image, parameters = crops.crop_view(given_view, SMALL)
    assert plain(image) == pytest.approx(expected[0], abs=0.01)
    assert parameters.tolist() == pytest.approx(expected[1], abs=1e-6)


@pytest.mark.parametrize(
    "box",
    [
        BoundingBox(20, 30, 120.5, 90.25),
        BoundingBox(-40, -30, 35, 20),
        BoundingBox(60, 70, 61, 71),
        BoundingBox(0, 0, 200, 150),
    ],
    ids=["fractions", "partly outside", "one pixel", "whole image"],
)
def test_the_published_size_to_the_letter(box: BoundingBox) -> None:
    image, parameters = crops.crop_view(view(box), PAPER)
    expected = by_the_description(view(box), 224)
    assert expected is not None
    assert plain(image) == pytest.approx(expected[0], abs=0.01)
    assert parameters.tolist() == pytest.approx(expected[1], abs=1e-6)


@settings(max_examples=40)
@given(boxes.filter(overlaps))
def test_the_crop_is_the_padded_square_resized(box: BoundingBox) -> None:
    given_view = view(box)
    image, parameters = crops.crop_view(given_view, SMALL)
    left, top, side = crops.crop_square(box)
    padded = np.zeros((150 + 1200, 200 + 1200, 3))
    padded[600:750, 600:800] = given_view.image
    expected = resized(padded[600 + top : 600 + top + side, 600 + left : 600 + left + side], 32)
    assert plain(image) == pytest.approx(expected, abs=0.01)
    assert image.dtype == parameters.dtype == torch.float32
    assert torch.equal(parameters, crops.crop_parameters(left, top, side, 200, 150))


@given(boxes.filter(overlaps), st.integers(0, 40), st.integers(0, 40))
def test_a_crop_that_arrives_already_cut_gives_the_same(box: BoundingBox, right: int, down: int) -> None:
    """The part of the image that holds the square, however much more comes with it."""
    whole = view(box)
    left, top, side = crops.crop_square(box)
    x0, y0 = max(0, left - right), max(0, top - down)
    part = whole.image[y0 : max(y0, top + side + down), x0 : max(x0, left + side + right)]
    cut = replace(whole, image=part, origin=(x0, y0))
    for ours, expected in zip(crops.crop_view(cut, SMALL), crops.crop_view(whole, SMALL), strict=True):
        assert torch.equal(ours, expected)


def test_what_a_cut_picture_lacks_is_black() -> None:
    box = BoundingBox(50, 50, 90, 90)
    whole = view(box)
    image, parameters = crops.crop_view(
        replace(whole, image=whole.image[50:90, 50:90], origin=(50, 50)), SMALL
    )
    left, top, side = crops.crop_square(box)
    padded = np.zeros_like(whole.image)
    padded[50:90, 50:90] = whole.image[50:90, 50:90]
    assert plain(image) == pytest.approx(
        resized(padded[top : top + side, left : left + side].astype(float), 32), abs=0.01
    )
    assert torch.equal(parameters, crops.crop_view(whole, SMALL)[1])


@settings(max_examples=40)
@given(boxes.filter(overlaps))
def test_with_a_mask_background_and_outside_are_white(box: BoundingBox) -> None:
    mask = np.random.default_rng(5).random((150, 200)) < 0.5
    masked = replace(view(box), mask=mask)
    image, _ = crops.crop_view(masked, SMALL)
    left, top, side = crops.crop_square(box)
    padded = np.full((150 + 1200, 200 + 1200, 3), 255.0)
    padded[600:750, 600:800] = np.where(mask[..., None], masked.image, 255)
    expected = resized(padded[600 + top : 600 + top + side, 600 + left : 600 + left + side], 32)
    assert plain(image) == pytest.approx(expected, abs=0.01)


def test_the_view_is_left_as_it_was() -> None:
    masked = replace(view(BoundingBox(0, 0, 100, 100)), mask=np.zeros((150, 200), bool))
    before = masked.image.copy()
    crops.crop_view(masked, SMALL)
    assert np.array_equal(masked.image, before)
    masked.image.flags.writeable = False
    crops.crop_view(masked, SMALL)


def test_an_antialiased_preset_averages_fine_texture_away() -> None:
    stripes = np.zeros((256, 256, 3), np.uint8)
    stripes[::2] = 255
    whole = View(stripes, BoundingBox(16, 16, 240, 240), 256, 256)
    smooth, _ = crops.crop_view(whole, replace(SMALL, crop_antialias=True), scale=1.0)
    sharp, _ = crops.crop_view(whole, SMALL, scale=1.0)
    assert plain(smooth) == pytest.approx(127.5, abs=20)
    assert np.ptp(plain(sharp)) == pytest.approx(
        255, abs=1
    )  # every seventh row: coarse stripes that are not there


@pytest.mark.parametrize(
    ("box", "words"),
    [
        (BoundingBox(10, 10, 10, 40), "holds no pixel"),
        (BoundingBox(10, 40, 30, 10), "holds no pixel"),
        (BoundingBox(float("nan"), 0, 10, 10), "holds no pixel"),
        (BoundingBox(0, 0, float("inf"), 10), "holds no pixel"),
        (BoundingBox(0, 0, 1e6, 10), "far larger than its image of 200 x 150"),
        (BoundingBox(300, 10, 340, 50), "lies beside its picture"),
        (BoundingBox(10, -90, 40, -50), "lies beside its picture"),
    ],
)
def test_boxes_without_a_crop_are_refused_with_their_numbers(box: BoundingBox, words: str) -> None:
    with pytest.raises(crops.CropError, match=words) as caught:
        crops.crop_view(view(box), SMALL)
    assert f"{box.x0:g}" in str(caught.value)


def test_a_mask_of_another_size_is_refused() -> None:
    masked = replace(view(BoundingBox(0, 0, 50, 50)), mask=np.ones((10, 20), bool))
    with pytest.raises(crops.CropError, match="mask is 20 x 10, its picture 200 x 150"):
        crops.crop_view(masked, SMALL)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_a_mask_of_other_than_truth_values_is_refused(dtype: type) -> None:
    """Numbers would be taken for rows of pixels, and other pixels than the background painted."""
    masked = replace(view(BoundingBox(0, 0, 50, 50)), mask=np.ones((150, 200), dtype))
    with pytest.raises(crops.CropError, match=f"mask is {np.dtype(dtype)}; it must be boolean"):
        crops.crop_view(masked, SMALL)


@pytest.mark.parametrize(
    "image",
    [np.ones((150, 200, 3), np.float32), np.ones((150, 200, 4), np.uint8), np.ones((150, 200), np.uint8)],
    ids=["fractions", "with alpha", "grey"],
)
def test_a_picture_that_is_no_8_bit_rgb_is_refused(image: np.ndarray) -> None:
    """Fractions of 1 would all be cut down to black."""
    with pytest.raises(crops.CropError, match=f"picture is {image.dtype} of shape .*8-bit RGB"):
        crops.crop_view(replace(view(BoundingBox(0, 0, 50, 50)), image=image), SMALL)
