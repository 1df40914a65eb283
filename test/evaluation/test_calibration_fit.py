"""What is fitted and measured on energies whose calibration is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from relpose_ros.evaluation.calibration_fit import (
    _position_sigma,
    _spread,
    expected_calibration_error,
    fit_calibration,
    measure_calibration,
    observe,
)
from relpose_ros.geometry import cameras, so3
from relpose_ros.inference.calibration import Calibration
from relpose_ros.inference.outlines import Outline
from relpose_ros.inference.pair_energies import GridEmbeddings

SIGMA = (0.03, 0.05, 0.12)


def fisher_angle(concentration, rng):
    """Draws the angle of an isotropic matrix Fisher rotation from its tabulated distribution."""
    angles = np.linspace(0, math.pi, 4001)
    density = np.exp(2 * concentration * (np.cos(angles) - 1)) * (1 - np.cos(angles))
    return np.interp(rng.random(), np.cumsum(density) / density.sum(), angles)


def observations(scene_type, count, temperature, seed):
    """Pairs of views whose truth is drawn from the energy's own density at a temperature."""
    rng = np.random.default_rng(seed)
    result = []
    grid = None
    for _ in range(count):
        concentration = float(rng.choice([4.0, 15.0, 60.0]))
        centre = so3.random_rotations(1, rng)[0]
        scene = scene_type(np.stack([np.eye(3), centre]), concentration)
        axis = rng.standard_normal(3)
        turn = so3.exp(axis / np.linalg.norm(axis) * fisher_angle(concentration / temperature, rng))
        rotations = np.stack([np.eye(3), turn @ centre])
        true = np.tile([0.0, 0.0, 1.0], (2, 1))
        predicted = true + rng.normal(0, SIGMA, (2, 3)) * [[0], [1]]
        grid = grid or GridEmbeddings(scene)
        result.append(observe(scene, grid, scene, predicted, [None, None], rotations, true))
    return result


@pytest.fixture(scope="module")
def overconfident(fisher_scene_type):
    """Energies three times as sharp as they should be."""
    return observations(fisher_scene_type[0], 100, 3.0, seed=0), observations(
        fisher_scene_type[0], 100, 3.0, seed=1
    )


def test_fit_recovers_a_known_temperature(overconfident):
    calibration = fit_calibration(overconfident[0])
    assert calibration.temperature == pytest.approx(3.0, rel=0.2)


def test_calibration_holds_on_scans_it_was_not_fitted_on(overconfident):
    fitted_on, unseen = overconfident
    before = measure_calibration(unseen, Calibration())
    after = measure_calibration(unseen, fit_calibration(fitted_on))
    assert after.log_likelihood > before.log_likelihood + 1
    assert after.expected_calibration_error < 0.6 * before.expected_calibration_error
    assert after.expected_calibration_error < 0.12
    for coverage in (after.pair_coverage, after.camera_rotation_coverage):
        np.testing.assert_allclose(coverage, (0.5, 0.9, 0.95), atol=0.12)
    assert before.pair_coverage[1] < 0.6


def test_well_calibrated_energies_are_left_alone(fisher_scene_type):
    calibration = fit_calibration(observations(fisher_scene_type[0], 80, 1.0, seed=2))
    assert calibration.temperature == pytest.approx(1.0, rel=0.2)
    assert calibration.pair_spread == pytest.approx(1.0, abs=0.3)


def test_distances_of_first_cameras_which_are_the_unit_say_nothing_of_the_others(overconfident):
    _, along = _position_sigma(overconfident[0] + overconfident[1], Calibration())
    assert along == pytest.approx(SIGMA[2], rel=0.15)


def test_as_much_of_a_uniform_distribution_as_asked_for_is_mixed_in(overconfident):
    assert fit_calibration(overconfident[0], least_flat=0.1).flat >= 0.1


def test_a_factor_that_does_not_bring_the_coverages_nearer_is_none():
    """Nearly right as they are: a factor that mends the one at 90% would spoil it."""
    assert _spread(np.repeat([2.0, 6.0, 7.0, 20.0], [50, 39, 6, 5])) == 1
    assert _spread(2 * np.random.default_rng(0).chisquare(3, 10_000)) == pytest.approx(2, rel=0.05)


def unit(vector):
    return vector / np.linalg.norm(vector)


@pytest.mark.parametrize("by_boxes", [True, False])
def test_cameras_are_placed_by_whichever_is_nearer_to_the_truth(fisher_scene_type, by_boxes):
    """The object is off the middle of the pictures, and at other distances than they all have in common."""
    rng = np.random.default_rng(5)
    grid, made = None, []
    for _ in range(20):
        rotations = fisher_scene_type[1](3, int(rng.integers(1 << 30)))
        scene = fisher_scene_type[0](rotations)
        grid = grid or GridEmbeddings(scene)
        true = rng.normal((0, 0, 1), 0.1, (3, 3))
        # The root of their area goes with the square of nearness: the half that is believed is all of it.
        sides = np.linalg.norm(true, axis=1) ** -2 * np.exp(rng.normal(0, 0 if by_boxes else 0.5, 3))
        boxes = [
            Outline(unit(t + rng.normal(0, 0.02, 3)), np.array([2.0, 0.5]) * side)
            for t, side in zip(true, sides, strict=True)
        ]
        about_axes = cameras.look_at_translations(rotations, true)[0]
        predicted = about_axes + rng.normal(0, 0.1 if by_boxes else 1e-4, (3, 3))
        made.append(observe(scene, grid, scene, predicted, boxes, rotations, true))
    fitted = fit_calibration(made)
    assert fitted.placed_by_boxes is by_boxes
    across, along = fitted.position_sigma
    assert (0.01 < across < 0.04) if by_boxes else (across < 0.01)
    assert along < 0.05
    assert fit_calibration(made, least_sigma=(0.05, 0.1)).position_sigma == (0.05, 0.1)


def test_expected_calibration_error_by_hand():
    stated = np.array([0.95, 0.95, 0.15, 0.15])
    right = np.array([True, False, False, False])
    assert expected_calibration_error(stated, right) == pytest.approx(0.5 * 0.45 + 0.5 * 0.15)


def test_truth_in_any_frame_and_unit(fisher_scene_type):
    """An object frame turned, moved and scaled is the same truth."""
    scene = fisher_scene_type[0](so3.random_rotations(3, np.random.default_rng(3)))
    rotations = scene.cameras
    translations = np.tile([0.0, 0.0, 2.0], (3, 1))
    moved = rotations @ so3.exp([0.3, 0.2, 0.1])
    shifted = 5 * (translations + moved @ [1.0, 2.0, 3.0])
    grid, outlines = GridEmbeddings(scene), [None] * 3
    one = observe(scene, grid, scene, translations, outlines, rotations, translations)
    other = observe(scene, grid, scene, translations, outlines, moved, shifted)
    np.testing.assert_allclose(one.true_rotations, other.true_rotations, atol=1e-9)
    np.testing.assert_allclose(one.true_translations, other.true_translations, atol=1e-6)
    torch.testing.assert_close(one.energy_at_truth, other.energy_at_truth, atol=1e-3, rtol=0)
