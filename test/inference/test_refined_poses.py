from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from relpose_ros.geometry import cameras, so3
from relpose_ros.inference.bundle_adjustment import refine
from relpose_ros.inference.camera_positions import apart, joined
from relpose_ros.inference.local_features import match
from relpose_ros.inference.matches import MATCHING_FLOOR, NOTHING, TwoViewGeometry
from relpose_ros.inference.refined_poses import _informative, settle
from relpose_ros.inference.two_view_poses import RelativePose

ANGLES = [0.0, 20.0, 40.0, 60.0]
BEFORE = np.diag([0.1**2] * 3 + [math.radians(5) ** 2] * 3)


def adjusted(scene, silent=(), noise=0.5, degrees=1.0, shift=0.02, seed=0, chance=lambda i, j: 0.95):
    """A bundle adjustment of poses that are a little off; ``silent`` cameras have no matches."""
    features = scene.features(noise=noise, seed=seed)
    geometries = {}
    for i, j in itertools.combinations(range(len(features)), 2):
        rotation, direction = scene.relative(i, j)
        pose = RelativePose(rotation, direction, 1e-4 * np.eye(3), 1e-4 * np.eye(3), 1.0)
        found = TwoViewGeometry((pose,), match(features[i], features[j]), chance(i, j))
        geometries[i, j] = NOTHING if i in silent or j in silent else found
    generator = np.random.default_rng([seed, 2])
    turns = np.radians(degrees) * generator.standard_normal((len(scene.rotations), 3))
    shifts = shift * generator.standard_normal(turns.shape)
    turns[0] = shifts[0] = 0
    return refine(so3.exp(turns) @ scene.rotations, scene.translations + shifts, features, geometries)


def before(count):
    covariances = np.tile(BEFORE, (count, 1, 1))
    covariances[0] *= 1e-4
    return joined(covariances)


def settled(refined, joint, **options):
    """Of cameras that look straight at the object."""
    return settle(refined, joint, np.tile([0.0, 0, 1], (len(refined.rotations), 1)), **options)


def true_centres(scene):
    """As the object frame has them: about the point closest to all axes, the first at distance 1."""
    translations, _, _ = cameras.look_at_translations(scene.rotations, scene.translations)
    return cameras.camera_centre(scene.rotations, translations)


def test_the_origin_is_where_the_axes_meet_and_the_first_camera_at_distance_one(point_scene):
    scene = point_scene.ring(ANGLES)
    refined = adjusted(scene)
    centres, _ = settled(refined, before(4))
    np.testing.assert_allclose(cameras.closest_point_to_axes(refined.rotations, centres), 0, atol=1e-9)
    assert np.linalg.norm(centres[0]) == pytest.approx(1)
    assert np.linalg.norm(centres - true_centres(scene), axis=1).max() < 0.02


def test_the_origin_is_where_the_lines_of_sight_meet(point_scene):
    """Of an object that is not where the axes meet."""
    scene = point_scene.ring(ANGLES)
    refined = adjusted(scene)
    seen = scene.translations + scene.rotations @ [0.2, 0.1, -0.1]
    sightlines = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    centres, joint = settle(refined, before(4), sightlines)
    rays = cameras.in_world(refined.rotations, sightlines)
    np.testing.assert_allclose(cameras.closest_point_to_rays(rays, centres), 0, atol=1e-9)
    true = cameras.camera_centre(scene.rotations, seen / np.linalg.norm(seen[0]))
    assert np.linalg.norm(centres - true, axis=1).max() < 0.02
    errors = (centres - true)[1:]
    stated = apart(joint)[1:, :3, :3]
    assert (np.einsum("na,nab,nb->n", errors, np.linalg.inv(stated), errors) < 16).all()


class Stretched:
    """A scene whose rays were worked out with a wrong focal length."""

    def __init__(self, scene, factor):
        self._scene, self._factor = scene, factor

    def __getattr__(self, name):
        return getattr(self._scene, name)

    def features(self, **settings):
        return [replace(each, rays=self._factor * each.rays) for each in self._scene.features(**settings)]


@pytest.mark.parametrize("angles", [[0.0, 15, 30], ANGLES, [0.0, 25, 50, 75, 100]])
@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_a_guessed_focal_length_that_is_wrong_is_allowed_for(angles, factor, point_scene):
    """Of one so wrong the errors are those of one standard deviation."""
    known, guessed = [], []
    for seed in range(4):
        scene = Stretched(point_scene.ring(angles, seed=seed), factor)
        refined = adjusted(scene, seed=seed)
        for errors, guess in ((known, False), (guessed, True)):
            _, joint = settled(refined, before(len(angles)), guessed=guess)
            for camera, covariance in enumerate(apart(joint)[1:, 3:, 3:], start=1):
                turn = so3.log(scene.rotations[camera].T @ refined.rotations[camera])
                errors.append(turn @ np.linalg.solve(covariance, turn))
    assert np.mean(guessed) < 4
    assert np.mean(known) > 3 * np.mean(guessed)


def test_errors_are_within_what_is_stated_and_that_is_less_than_before(point_scene):
    """Stated deviations are widened on purpose: features of a photograph do not err each for themselves."""
    turns, shifts = [], []
    for seed in range(6):
        scene = point_scene.ring(ANGLES, seed=seed)
        refined = adjusted(scene, noise=1.0, degrees=0.5, shift=0.01, seed=seed)
        centres, joint = settled(refined, before(4))
        covariances = apart(joint)
        np.testing.assert_array_equal(joint, joint.T)
        assert np.linalg.eigvalsh(joint).min() > 0
        errors = true_centres(scene) - centres
        for camera in range(1, 4):
            turn = so3.log(scene.rotations[camera].T @ refined.rotations[camera])
            turns.append(turn @ np.linalg.solve(covariances[camera, 3:, 3:], turn))
            error = errors[camera]
            shifts.append(error @ np.linalg.solve(covariances[camera, :3, :3], error))
            assert np.trace(covariances[camera, 3:, 3:]) < 0.2 * np.trace(BEFORE[3:, 3:])
            assert np.trace(covariances[camera, :3, :3]) < 0.2 * np.trace(BEFORE[:3, :3])
    assert np.mean(turns) < 3
    assert np.mean(shifts) < 3


def test_the_first_camera_which_sets_the_frame_is_known_as_before(point_scene):
    refined = adjusted(point_scene.ring(ANGLES))
    joint = settled(refined, before(4))[1]
    assert np.linalg.eigvalsh(joint[3:6, 3:6]).max() <= 1e-4 * BEFORE[3, 3] * (1 + 1e-9)


def test_no_number_of_points_averages_the_intrinsics_away(point_scene):
    refined = adjusted(point_scene.ring(ANGLES, points=400), noise=0.01)
    centres, joint = settled(refined, before(4))
    for centre, covariance in zip(centres[1:], apart(joint)[1:], strict=True):
        assert np.linalg.eigvalsh(covariance[3:, 3:]).min() >= MATCHING_FLOOR**2
        assert np.linalg.eigvalsh(covariance[:3, :3]).min() >= MATCHING_FLOOR**2 * centre @ centre


def test_a_guessed_focal_length_turns_a_camera_about_the_object(point_scene):
    """So that it sees the object's middle where it did: a turn r and a shift r x c go together."""
    refined = adjusted(point_scene.ring(ANGLES))
    (centres, known), (_, guessed) = (settled(refined, before(4), guessed=guess) for guess in (False, True))
    for camera in range(1, 4):
        more = apart(guessed - known)[camera]
        assert np.trace(more[3:, 3:]) > 1e-3
        seen = np.concatenate([np.eye(3), so3.hat(centres[camera])], 1)
        np.testing.assert_allclose(seen @ more @ seen.T, 0, atol=1e-9)


def test_fewer_points_know_less(point_scene):
    many, few = (
        settled(adjusted(point_scene.ring(ANGLES, points=count)), before(4))[1] for count in (200, 40)
    )
    for rich, poor in zip(apart(many)[1:], apart(few)[1:], strict=True):
        assert np.trace(rich[3:, 3:]) < np.trace(poor[3:, 3:])
        assert np.trace(rich[:3, :3]) < np.trace(poor[:3, :3])


def test_a_camera_that_took_no_part_keeps_what_was_known_of_it(point_scene):
    scene = point_scene.ring(ANGLES)
    refined = adjusted(scene, silent=(2,))
    assert refined.moved == (0, 1, 3)
    centres, joint = settled(refined, before(4))
    np.testing.assert_array_equal(apart(joint)[2], BEFORE)
    np.testing.assert_array_equal(joint[12:18, :12], 0)
    np.testing.assert_allclose(centres[2], cameras.camera_centre(refined.rotations, refined.translations)[2])
    # Its axis belongs to the origin too, and nobody knows it.
    whole = settled(adjusted(scene), before(4))[1]
    assert np.trace(joint[6:9, 6:9]) > 2 * np.trace(whole[6:9, 6:9])


def test_cameras_apart_from_the_first_are_known_among_themselves_alone(point_scene):
    scene = point_scene.ring(ANGLES)
    refined = adjusted(scene, silent=(0,))
    assert refined.moved == (1, 2, 3)
    _, joint = settled(refined, before(4))
    assert np.trace(joint[9:12, 9:12]) > 0.3 * np.trace(BEFORE[3:, 3:])
    relative = joint[9:12, 9:12] + joint[15:18, 15:18] - joint[9:12, 15:18] - joint[15:18, 9:12]
    assert np.trace(relative) < 0.1 * np.trace(BEFORE[3:, 3:])


def test_cameras_apart_from_the_first_keep_its_frame_and_unit(point_scene):
    refined = adjusted(point_scene.ring(ANGLES), silent=(0,))
    centres, _ = settled(refined, before(4))
    np.testing.assert_array_equal(centres, cameras.camera_centre(refined.rotations, refined.translations))


def test_an_origin_behind_a_camera_is_none(point_scene):
    """Lines of sight that meet where nobody looks, as of a box around something else."""
    refined = adjusted(point_scene.ring(ANGLES))
    centres, joint = settle(refined, before(4), np.tile([0.0, 0, -1], (4, 1)))
    np.testing.assert_array_equal(centres, cameras.camera_centre(refined.rotations, refined.translations))
    assert np.linalg.eigvalsh(joint).min() > 0


def test_errors_that_a_camera_shared_with_those_that_moved_are_its_own_now(point_scene):
    refined = adjusted(point_scene.ring(ANGLES), silent=(2,))
    shared = before(4) + 1e-4 * np.kron(np.ones((4, 4)), np.eye(6))
    _, joint = settled(refined, shared)
    np.testing.assert_array_equal(joint[12:18, 12:18], shared[12:18, 12:18])
    np.testing.assert_array_equal(joint[12:18, [*range(12), *range(18, 24)]], 0)
    assert np.linalg.eigvalsh(joint).min() > 0


def test_axes_that_hardly_meet_leave_origin_and_unit_as_they_were(point_scene):
    """Positions were known better than two degrees between the axes tell."""
    scene = point_scene.ring([0.0, 2.0, 4.0])
    refined = adjusted(scene, degrees=0.2, shift=0.002)
    known = joined(np.tile(np.diag([0.002**2] * 3 + [math.radians(5) ** 2] * 3), (3, 1, 1)))
    centres, _ = settled(refined, known)
    np.testing.assert_array_equal(centres, cameras.camera_centre(refined.rotations, refined.translations))


def test_matches_that_are_not_sure_leave_it_to_what_was_known_how_groups_go_together(point_scene):
    """Two pairs of cameras that share points, tied by matches as likely wrong as not."""
    scene = point_scene.ring(ANGLES)
    sure, unsure = (adjusted(scene, chance=lambda i, j, c=c: c if i < 2 <= j else 0.95) for c in (0.95, 0.6))
    assert sure.groups == ((0, 1, 2, 3),)
    assert unsure.groups == ((0, 1), (2, 3))
    np.testing.assert_array_equal(sure.rotations, unsure.rotations)
    for camera in (2, 3):
        known, guessed = (apart(settled(each, before(4))[1])[camera] for each in (sure, unsure))
        assert np.trace(known[3:, 3:]) < 0.1 * np.trace(BEFORE[3:, 3:])
        assert np.trace(guessed[3:, 3:]) == pytest.approx(np.trace(BEFORE[3:, 3:]), rel=0.15)
    joint = settled(unsure, before(4))[1]
    relative = joint[15:18, 15:18] + joint[21:24, 21:24] - joint[15:18, 21:24] - joint[21:24, 15:18]
    assert np.trace(relative) < 0.1 * np.trace(BEFORE[3:, 3:])


def test_rounding_leaves_no_negative_information():
    axes = so3.exp([0.3, -0.2, 0.9])
    sound, unsound = (axes * [4.0, 1.0, least] @ axes.T for least in (0.0, -3.0))
    np.testing.assert_allclose(_informative(unsound), sound, atol=1e-12)
    np.testing.assert_allclose(_informative(sound), sound, atol=1e-12)
