from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from relpose_ros.geometry import so3, so3_grid
from relpose_ros.inference.rotation_evidence import FREEDOM, Peak, RotationEvidence

TILTED = np.array([[0.020, 0.006, 0.0], [0.006, 0.010, -0.002], [0.0, -0.002, 0.015]])


def log_density(peaks, rotations, blur=0.0):
    """Of one pair. (K, 3, 3) -> (K,)."""
    evidence = RotationEvidence([peaks])
    return evidence(torch.zeros(1, dtype=torch.int64), torch.from_numpy(rotations), blur)[0].numpy()


def rotation(seed):
    return so3.random_rotations(1, np.random.default_rng(seed))[0]


@pytest.mark.parametrize(("deviation", "probability"), [(8, 0.9), (20, 0.5), (0.3, 0.95)])
def test_integrates_to_one(deviation, probability):
    """Blurred as the search blurs it, the mean over a grid's cells is one, however sharp the peak."""
    grid = np.array(so3_grid.grid(3))
    blur = so3_grid.cell_spacing(3) / 2
    peak = Peak(rotation(0), math.radians(deviation) ** 2 * np.eye(3), probability)
    mean = np.exp(log_density([peak], grid, blur)).mean()
    # In Cayley's measure instead of Haar's, far tails weigh a little differently.
    assert mean == pytest.approx(1, abs=0.06)


def test_the_height_of_a_peak_is_that_of_students_t():
    peak = Peak(rotation(1), 0.05 * TILTED, 0.8)
    volume = 8 * math.pi**2  # of SO(3), in the measure of rotation vectors
    constant = math.gamma((FREEDOM + 3) / 2) / math.gamma(FREEDOM / 2) / (FREEDOM * math.pi) ** 1.5
    height = constant / math.sqrt(np.linalg.det(0.05 * TILTED)) * volume
    at_peak = log_density([peak], peak.rotation[None])[0]
    assert at_peak == pytest.approx(math.log(0.8 * height + 0.2), abs=1e-9)


def test_small_turns_are_measured_by_the_covariance_in_the_axes_of_camera_j():
    peak = Peak(rotation(2), TILTED, 0.999999)
    turns = 0.02 * np.random.default_rng(0).standard_normal((20, 3))
    values = log_density([peak], so3.exp(turns) @ peak.rotation)
    squares = np.einsum("ka,ab,kb->k", turns, np.linalg.inv(TILTED), turns)
    expected = -(FREEDOM + 3) / 2 * np.log1p(squares / FREEDOM)
    np.testing.assert_allclose(values - log_density([peak], peak.rotation[None]), expected, atol=2e-4)


def test_falls_all_the_way_to_half_a_turn():
    """No second maximum on the far side: along any axis the density only falls."""
    peak = Peak(rotation(3), TILTED, 0.9)
    angles = np.linspace(0, math.pi, 100)
    for axis in np.random.default_rng(1).standard_normal((8, 3)):
        axis = axis / np.linalg.norm(axis)
        values = log_density([peak], so3.exp(angles[:, None] * axis) @ peak.rotation)
        assert (np.diff(values) < 0).all()
    # Rotations on the far side, some of half a turn, are at the flat rest.
    far = so3.exp(math.pi * np.eye(3)) @ peak.rotation
    np.testing.assert_allclose(log_density([peak], far), math.log(0.1), atol=0.3)


def test_the_rest_is_a_finite_price():
    """Contradicting a peak, however sharp, costs no more than its probability says."""
    peak = Peak(rotation(4), math.radians(0.3) ** 2 * np.eye(3), 0.99)
    away = so3.exp([1.5, 0.5, -0.8]) @ peak.rotation
    assert log_density([peak], away[None])[0] == pytest.approx(math.log(0.01), abs=0.05)


def test_two_peaks_are_a_mixture():
    first, second = Peak(rotation(5), TILTED, 0.5), Peak(rotation(6), TILTED / 2, 0.3)
    at = so3.random_rotations(30, np.random.default_rng(2))
    alone = [np.exp(log_density([peak], at)) - (1 - peak.probability) for peak in (first, second)]
    together = np.exp(log_density([first, second], at))
    np.testing.assert_allclose(together, alone[0] + alone[1] + 0.2, atol=1e-9)


def test_no_peak_is_no_opinion():
    """Exactly zero and flat, also beside pairs that have one."""
    evidence = RotationEvidence([[], [Peak(np.eye(3), TILTED, 0.5)], []])
    assert evidence.spoken == (False, True, False)
    rotations = torch.from_numpy(so3.random_rotations(10, np.random.default_rng(3))).view(2, 5, 3, 3)
    for value in (
        evidence(torch.tensor([0, 2]), rotations),
        *evidence.with_gradients(torch.tensor([0, 2]), rotations),
    ):
        assert (value == 0).all()


def test_rotations_of_each_pair_or_the_same_for_all():
    evidence = RotationEvidence([[Peak(rotation(k), TILTED, 0.5)] for k in range(3)])
    pairs = torch.tensor([2, 0])
    at = torch.from_numpy(so3.random_rotations(7, np.random.default_rng(4)))
    shared = evidence(pairs, at)
    assert shared.shape == (2, 7)
    torch.testing.assert_close(shared, evidence(pairs, at.expand(2, 7, 3, 3)))
    torch.testing.assert_close(shared[1], evidence(torch.tensor([0]), at)[0])
    assert not torch.equal(shared[0], shared[1])


def skew(gradients, rotations):
    """What of derivatives by entries a turn sees: at a peak the rest depends on rounding."""
    turns = gradients @ rotations.detach().mT
    return turns - turns.mT


def test_the_slope_is_that_of_the_value():
    evidence = RotationEvidence([[Peak(rotation(7), TILTED, 0.6), Peak(rotation(8), 0.1 * TILTED, 0.3)]])
    pair = torch.zeros(1, dtype=torch.int64)
    centres = [
        rotation(9),
        so3.exp([0.1, 0, -0.05]) @ rotation(7),
        rotation(8),
        so3.exp([2, 2, 0]) @ rotation(7),
    ]
    rotations = torch.from_numpy(np.stack(centres))[None].requires_grad_()
    values = evidence(pair, rotations)
    (expected,) = torch.autograd.grad(values.sum(), rotations)
    found, gradients = evidence.with_gradients(pair, rotations.detach())
    torch.testing.assert_close(found, values.detach())
    torch.testing.assert_close(skew(gradients, rotations), skew(expected, rotations))


def test_blur_widens_by_its_variance():
    blurred = log_density(
        [Peak(np.eye(3), TILTED, 0.7)], so3.random_rotations(9, np.random.default_rng(5)), 0.1
    )
    wider = log_density(
        [Peak(np.eye(3), TILTED + 0.01 * np.eye(3), 0.7)], so3.random_rotations(9, np.random.default_rng(5))
    )
    np.testing.assert_allclose(blurred, wider)


def test_peaks_that_leave_nothing_to_doubt_are_refused():
    with pytest.raises(ValueError, match="sum to less than one"):
        RotationEvidence([[Peak(np.eye(3), TILTED, 0.6), Peak(np.eye(3), TILTED, 0.4)]])
