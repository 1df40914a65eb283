"""What a camera does to a picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relpose_ros.captures import photography
from relpose_ros.captures.photography import Camera

NEUTRAL = Camera(
    target=0.5,
    control=1.0,
    balance=(1.0, 1.0, 1.0),
    contrast=1.0,
    saturation=1.0,
    blur=0.0,
    grain=0.0,
    jpeg_quality=100,
    sharpening=0.0,
)
RAMP = np.repeat(np.linspace(20, 120, 64).astype(np.uint8)[None, :, None], 48, 0).repeat(3, 2)


@given(st.integers(0, 10_000))
def test_pictures_keep_their_shape_and_what_is_outside_stays_black(seed: int) -> None:
    rng = np.random.default_rng(seed)
    within = np.zeros((48, 64), bool)
    within[:, 10:50] = True
    picture = np.where(within[..., None], RAMP, 0).astype(np.uint8)
    result = photography.develop(picture, photography.random_camera(rng), rng, within)
    assert result.shape == picture.shape
    assert result.dtype == np.uint8
    assert (result[~within] == 0).all()
    assert result[within].any()


def test_exposure_control_reaches_its_target() -> None:
    dark = (RAMP // 3).astype(np.uint8)
    means = [photography.develop(p, NEUTRAL, np.random.default_rng(1)).mean() for p in (dark, RAMP)]
    assert means[1] == pytest.approx(127, rel=0.2)
    # An exposure of at most three times is all a camera can add.
    assert dark.mean() * 2 < means[0] <= dark.mean() * 3.3


def test_the_same_seed_develops_the_same_picture() -> None:
    camera = replace(NEUTRAL, grain=5.0, jpeg_quality=60, blur=0.7)
    first, again = (photography.develop(RAMP, camera, np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, photography.develop(RAMP, camera, np.random.default_rng(4)))


def test_grain_is_as_strong_as_it_is_said() -> None:
    flat = np.full((300, 400, 3), 128, np.uint8)
    camera = replace(NEUTRAL, grain=6.0)
    noisy = photography.develop(flat, camera, np.random.default_rng(0))
    assert noisy.std(axis=(0, 1)).mean() == pytest.approx(6.0, rel=0.1)
