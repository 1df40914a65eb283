"""Rotations: group axioms, inverse pairs, and the ends where naive formulas fail."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from relpose_ros.geometry import so3

vectors = arrays(np.float64, (3,), elements=st.floats(-1, 1, width=32))
angles = st.one_of(
    st.sampled_from([0.0, 1e-12, 1e-7, 9.9e-5, 1.1e-4, np.pi - 1e-9, np.pi / 2]), st.floats(0, np.pi - 1e-6)
)
seeds = st.integers(0, 2**31)


def unit(vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-3 else np.array([0.6, 0.0, -0.8])


def rotations(seed: int, count: int) -> np.ndarray:
    return so3.random_rotations(count, np.random.default_rng(seed))


@given(vectors, angles)
def test_exp_is_a_rotation_that_keeps_its_axis_and_log_undoes_it(vector: np.ndarray, angle: float) -> None:
    axis = unit(vector)
    rotation = so3.exp(angle * axis)
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-13)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert rotation @ axis == pytest.approx(axis, abs=1e-13)
    assert so3.log(rotation) == pytest.approx(angle * axis, abs=1e-12)


@given(vectors, angles)
def test_exp_agrees_with_the_power_series(vector: np.ndarray, angle: float) -> None:
    generator = so3.hat(angle * unit(vector))
    term = total = np.eye(3)
    for order in range(1, 40):
        term = term @ generator / order
        total = total + term
    assert so3.exp(angle * unit(vector)) == pytest.approx(total, abs=1e-12)


@given(vectors)
def test_half_a_turn_is_recovered_up_to_the_sign_of_its_axis(vector: np.ndarray) -> None:
    rotation = so3.exp(np.pi * unit(vector))
    back = so3.log(rotation)
    assert np.linalg.norm(back) == pytest.approx(np.pi)
    assert so3.exp(back) == pytest.approx(rotation, abs=1e-12)


@given(vectors, vectors)
def test_hat_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    assert so3.hat(a) @ b == pytest.approx(np.cross(a, b), abs=1e-12)


@given(vectors, angles, seeds)
def test_angle_between_is_the_angle_turned_and_is_invariant(
    vector: np.ndarray, angle: float, seed: int
) -> None:
    start, other = rotations(seed, 2)
    end = so3.exp(angle * unit(vector)) @ start
    assert so3.angle_between(end, start) == pytest.approx(angle, abs=1e-12)
    assert so3.angle_between(end @ other, start @ other) == pytest.approx(angle, abs=1e-12)
    assert so3.angle_between(other @ end, other @ start) == pytest.approx(angle, abs=1e-12)


def test_angle_between_distinguishes_tiny_angles_where_arccos_cannot() -> None:
    assert so3.angle_between(so3.exp([1e-9, 0, 0]), np.eye(3)) == pytest.approx(1e-9, rel=1e-6)


@given(seeds)
def test_quaternions_and_matrices_are_the_same_rotations(seed: int) -> None:
    rotation = np.concatenate([rotations(seed, 4), so3.exp(np.pi * np.eye(3)), [np.eye(3)]])
    quaternion = so3.quaternion_xyzw(rotation)
    assert (quaternion[:, 3] >= 0).all()
    assert np.linalg.norm(quaternion, axis=1) == pytest.approx(1)
    assert so3.from_quaternion_xyzw(quaternion) == pytest.approx(rotation, abs=1e-14)
    assert so3.from_quaternion_xyzw(-2 * quaternion) == pytest.approx(rotation, abs=1e-14)


def test_a_quaternion_by_hand() -> None:
    quarter_turn_about_z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    half = np.sqrt(0.5)
    assert so3.quaternion_xyzw(quarter_turn_about_z) == pytest.approx([0, 0, half, half])


@given(seeds)
def test_log_and_exp_take_any_leading_dimensions(seed: int) -> None:
    stack = rotations(seed, 6)
    assert so3.log(stack.reshape(2, 3, 3, 3)).reshape(6, 3) == pytest.approx(
        np.stack([so3.log(r) for r in stack])
    )
    assert so3.exp(so3.log(stack).reshape(3, 2, 3)).shape == (3, 2, 3, 3)


def test_random_rotations_are_uniform() -> None:
    drawn = rotations(0, 20_000)
    # The trace of a uniform rotation is 1 + 2 cos(a) with density (1 - cos a) / pi of the angle a.
    angle = so3.angle_between(drawn, np.eye(3))
    counts, edges = np.histogram(angle, bins=12, range=(0, np.pi))
    expected = np.diff(edges - np.sin(edges)) / np.pi * len(drawn)
    assert ((counts - expected) ** 2 / expected).sum() < 31  # chi squared, 11 degrees of freedom: one in 1000
    assert np.abs(drawn.mean(0)).max() < 0.02


@given(seeds)
def test_projection_finds_the_nearest_rotation(seed: int) -> None:
    generator = np.random.default_rng(seed)
    matrix = generator.standard_normal((3, 3))
    nearest = so3.project(matrix)
    assert nearest @ nearest.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(nearest) == pytest.approx(1)
    others = so3.random_rotations(500, generator)
    assert np.linalg.norm(matrix - nearest) <= np.linalg.norm(matrix - others, axis=(1, 2)).min() + 1e-12


@given(seeds, st.floats(0, 1))
def test_mean_of_two_lies_between_them_by_weight(seed: int, weight: float) -> None:
    a, b = rotations(seed, 2)
    b = so3.exp(0.5 * so3.log(b @ a.T)) @ a
    mean = so3.mean([a, b], [1 - weight, weight])
    whole = so3.angle_between(a, b)
    assert so3.angle_between(a, mean) + so3.angle_between(mean, b) == pytest.approx(whole, abs=1e-6)
    assert so3.mean([a, b]) == pytest.approx(so3.exp(0.5 * so3.log(b @ a.T)) @ a, abs=1e-9)


def test_the_ball_s_fraction_is_that_of_random_rotations() -> None:
    turned = so3.angle_between(so3.random_rotations(20000, np.random.default_rng(0)), np.eye(3))
    for angle in (0.5, 1.0, 2.0, 3.0):
        assert so3.ball_fraction(angle) == pytest.approx((turned <= angle).mean(), abs=0.01)
    assert so3.ball_fraction(np.pi) == pytest.approx(1)
