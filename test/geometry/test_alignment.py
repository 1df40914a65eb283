"""Alignments: what was moved is found again, and nothing beats the answer."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relpose_ros.geometry import alignment, so3

seeds = st.integers(0, 2**31)


def error(similarity: alignment.Similarity, source: np.ndarray, target: np.ndarray) -> float:
    return float(((similarity.apply(source) - target) ** 2).sum())


@given(seeds, st.integers(3, 9))
def test_a_similarity_is_recovered(seed: int, count: int) -> None:
    generator = np.random.default_rng(seed)
    source = generator.normal(size=(count, 3))
    truth = alignment.Similarity(
        generator.uniform(0.1, 10), so3.random_rotations(1, generator)[0], generator.normal(size=3)
    )
    found = alignment.align_points(source, truth.apply(source))
    assert found.apply(source) == pytest.approx(truth.apply(source), abs=1e-8)
    assert found.scale == pytest.approx(truth.scale)
    assert found.rotation == pytest.approx(truth.rotation, abs=1e-5)


@given(seeds)
def test_no_nearby_similarity_is_better(seed: int) -> None:
    generator = np.random.default_rng(seed)
    source, target = generator.normal(size=(2, 5, 3))
    best = alignment.align_points(source, target)
    assert np.linalg.det(best.rotation) == pytest.approx(1)
    for _ in range(20):
        scale, turn, shift = generator.normal(), generator.normal(size=3), generator.normal(size=3)
        other = alignment.Similarity(
            best.scale * (1 + 0.05 * scale),
            so3.exp(0.05 * turn) @ best.rotation,
            best.translation + 0.05 * shift,
        )
        assert error(best, source, target) <= error(other, source, target) + 1e-9


def test_a_mirror_image_keeps_an_error() -> None:
    source = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    mirrored = source * [1, 1, -1]
    best = alignment.align_points(source, mirrored)
    assert np.linalg.det(best.rotation) == pytest.approx(1)
    assert error(best, source, mirrored) > 0.1


def test_two_points_always_fit_and_one_place_has_no_scale() -> None:
    two = np.array([[0.0, 0, 0], [1, 0, 0]])
    target = np.array([[1.0, 1, 1], [1, 4, 1]])
    assert alignment.align_points(two, target).apply(two) == pytest.approx(target, abs=1e-12)
    assert alignment.align_points(two[:1].repeat(2, 0), target).scale == 0


@given(seeds)
def test_rotations_are_aligned_by_a_turn_of_the_world(seed: int) -> None:
    generator = np.random.default_rng(seed)
    truth = so3.random_rotations(4, generator)
    (turn,) = so3.random_rotations(1, generator)
    assert alignment.align_rotations(truth @ turn.T, truth) == pytest.approx(turn, abs=1e-9)


@given(seeds)
def test_translations_are_aligned_by_scale_and_origin(seed: int) -> None:
    generator = np.random.default_rng(seed)
    rotation, truth = so3.random_rotations(5, generator), generator.normal(size=(5, 3))
    scale, shift = generator.uniform(0.1, 10), generator.normal(size=3)
    found_scale, found_shift = alignment.align_translations(scale * truth + rotation @ shift, rotation, truth)
    assert found_scale == pytest.approx(scale)
    assert found_shift == pytest.approx(shift, abs=1e-7)
