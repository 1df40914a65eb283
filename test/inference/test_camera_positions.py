from __future__ import annotations

import math

import numpy as np
import pytest

from relpose_ros.geometry import cameras, so3
from relpose_ros.inference.camera_positions import Baseline, apart, baseline, joined, place

LOOSE, EXACT, TURN = 0.2, math.radians(1), math.radians(5)


def around(count, seed):
    """Cameras at distance 1 that look at the origin. -> rotations, centres."""
    generator = np.random.default_rng(seed)
    centres = generator.standard_normal((count, 3))
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    return cameras.look_at(centres, np.zeros(3)), centres


def prior(rotations, shift=LOOSE, turn=TURN):
    """Covariances of cameras whose turn moves them too, as an estimate has them; the first is held."""
    covariances = []
    for camera in range(len(rotations)):
        scale = 1.0 if camera else 0.01
        position, rotation = (scale * shift) ** 2 * np.eye(3), (scale * turn) ** 2 * np.eye(3)
        cross = 0.5 * scale**2 * shift * turn * so3.exp([0.3, camera, 0.1])
        covariances.append(np.block([[position, cross], [cross.T, rotation]]))
    return np.array(covariances)


def all_baselines(rotations, centres, deviation=EXACT):
    found = []
    for i in range(len(centres)):
        for j in range(i + 1, len(centres)):
            relative = rotations[j] @ rotations[i].T
            translation = rotations[j] @ (centres[i] - centres[j])  # of camera_j_from_camera_i
            np.testing.assert_allclose(
                translation,
                cameras.translation_of(rotations[j], centres[j])
                - relative @ cameras.translation_of(rotations[i], centres[i]),
                atol=1e-12,
            )
            direction = translation / np.linalg.norm(translation)
            across = np.eye(3) - np.outer(direction, direction)
            found.append(baseline(i, j, rotations[j], direction, deviation**2 * across, np.zeros((3, 3))))
    return found


def moved(centres, seed, deviation=LOOSE / 2):
    shifts = deviation * np.random.default_rng(seed).standard_normal(centres.shape)
    shifts[0] = 0
    return centres + shifts


def shape_error(found, truth):
    """Largest error of a centre once the scale, which directions leave free, is set right."""
    a, b = found - found[0], truth - truth[0]
    return np.linalg.norm(a * (a * b).sum() / (a * a).sum() - b, axis=1).max()


def test_without_directions_nothing_changes():
    rotations, centres = around(3, 0)
    joint = joined(prior(rotations))
    found, updated = place(centres, joint, [])
    np.testing.assert_array_equal(found, centres)
    np.testing.assert_array_equal(updated, joint)


def test_cameras_are_joined_and_taken_apart():
    covariances = prior(around(3, 0)[0])
    joint = joined(covariances)
    np.testing.assert_array_equal(apart(joint), covariances)
    np.testing.assert_array_equal(joint, joint.T)
    np.testing.assert_array_equal(joint[6:12, 12:], 0)


@pytest.mark.parametrize("seed", range(4))
def test_exact_directions_recover_the_shape(seed):
    rotations, centres = around(5, seed)
    start = moved(centres, seed)
    found, _ = place(start, joined(prior(rotations)), all_baselines(rotations, centres))
    assert shape_error(start, centres) > 0.08
    assert shape_error(found, centres) < 0.03
    np.testing.assert_allclose(found[0], centres[0], atol=0.01)


def test_directions_that_agree_change_no_position():
    rotations, centres = around(4, 1)
    found, _ = place(centres, joined(prior(rotations)), all_baselines(rotations, centres))
    np.testing.assert_allclose(found, centres, atol=1e-9)


@pytest.mark.parametrize("backwards", [False, True])
def test_one_wrong_direction_is_outvoted(backwards):
    rotations, centres = around(5, 2)
    baselines = all_baselines(rotations, centres)
    wrong = baselines[4]
    turned = -wrong.direction if backwards else so3.exp([0.9, -0.6, 0.4]) @ wrong.direction
    baselines[4] = Baseline(wrong.i, wrong.j, turned, wrong.covariance)
    found, _ = place(moved(centres, 2), joined(prior(rotations)), baselines)
    assert shape_error(found, centres) < 0.04


def test_vague_directions_hardly_move_well_known_positions():
    rotations, centres = around(4, 3)
    start = moved(centres, 3, 0.05)
    vague = all_baselines(rotations, centres, deviation=math.radians(40))
    found, _ = place(start, joined(prior(rotations, shift=0.02)), vague)
    assert np.linalg.norm(found - start, axis=1).max() < 0.01


def test_covariances_shrink_across_the_directions_and_stay_covariances():
    rotations, centres = around(4, 4)
    before = prior(rotations)
    baselines = all_baselines(rotations, centres)
    _, joint = place(moved(centres, 4, 0.02), joined(before), baselines)
    np.testing.assert_array_equal(joint, joint.T)
    assert np.linalg.eigvalsh(joint).min() > 0
    after = apart(joint)
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(new, new.T)
        assert np.linalg.eigvalsh(new).min() > 0
        # Nothing is known less than before, in any direction of the six.
        assert np.linalg.eigvalsh(old - new).min() > -1e-9
    for camera in range(1, 4):
        across = np.eye(3) - np.outer(baselines[camera - 1].direction, baselines[camera - 1].direction)
        seen = np.trace(across @ after[camera, :3, :3])
        assert seen < 0.1 * np.trace(across @ before[camera, :3, :3])
        # Position and turn went together: what tells of one tells of the other.
        assert np.trace(after[camera, 3:, 3:]) < 0.95 * np.trace(before[camera, 3:, 3:])


def test_of_two_cameras_the_distance_stays_unknown():
    rotations, centres = around(2, 5)
    (only,) = all_baselines(rotations, centres)
    before = prior(rotations)
    _, joint = place(centres, joined(before), [only])
    along = only.direction @ apart(joint)[1, :3, :3] @ only.direction
    assert along == pytest.approx(LOOSE**2, rel=0.01)


def test_a_direction_that_points_backwards_is_hardly_believed():
    rotations, centres = around(2, 5)
    (only,) = all_baselines(rotations, centres)
    _, right = place(centres, joined(prior(rotations)), [only])
    found, wrong = place(
        centres, joined(prior(rotations)), [Baseline(0, 1, -only.direction, only.covariance)]
    )
    np.testing.assert_allclose(found, centres, atol=1e-6)
    across = np.eye(3) - np.outer(only.direction, only.direction)
    spread = [np.trace(across @ apart(joint)[1, :3, :3]) for joint in (wrong, right)]
    assert spread[0] > 10 * spread[1]


def test_a_baseline_points_from_the_first_centre_to_the_second():
    rotations, centres = around(2, 6)
    (only,) = all_baselines(rotations, centres)
    difference = centres[1] - centres[0]
    np.testing.assert_allclose(only.direction, difference / np.linalg.norm(difference), atol=1e-12)
    np.testing.assert_allclose(only.covariance @ only.direction, 0, atol=1e-15)


def test_the_cameras_own_turn_makes_its_direction_uncertain():
    direction = np.array([0.0, 0.6, 0.8])
    turn = np.diag([0.04, 0.01, 0.01])
    still = baseline(0, 1, np.eye(3), direction, np.zeros((3, 3)), np.zeros((3, 3)))
    turned = baseline(0, 1, np.eye(3), direction, np.zeros((3, 3)), turn)
    np.testing.assert_array_equal(still.direction, turned.direction)
    # As large in trace as what moves the direction: turns about the two axes across it.
    assert np.trace(turned.covariance) == pytest.approx(0.04 + 0.01)
    np.testing.assert_allclose(turned.covariance @ direction, 0, atol=1e-15)


def test_cameras_in_one_place_hold_nothing():
    """No distance to divide by: finite, and hardly moved."""
    rotations, _ = around(2, 7)
    centres = np.tile([0.0, 0.0, -1.0], (2, 1))
    direction = Baseline(0, 1, np.array([1.0, 0, 0]), EXACT**2 * np.diag([0.0, 1, 1]))
    found, covariances = place(centres, joined(prior(rotations)), [direction])
    np.testing.assert_allclose(found, centres, atol=1e-9)
    assert np.isfinite(covariances).all()


def test_errors_of_cameras_with_a_direction_between_them_go_together():
    rotations, centres = around(2, 5)
    (only,) = all_baselines(rotations, centres)
    _, joint = place(centres, joined(prior(rotations)), [only])
    across = np.eye(3) - np.outer(only.direction, only.direction)
    difference = joint[:3, :3] + joint[6:9, 6:9] - joint[:3, 6:9] - joint[6:9, :3]
    length = np.linalg.norm(centres[1] - centres[0])
    # Across the direction two axes: each is known to the direction's deviation times the length.
    assert np.trace(across @ difference) == pytest.approx(2 * (EXACT * length) ** 2, rel=0.05)
