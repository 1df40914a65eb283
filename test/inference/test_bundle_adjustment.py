from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from relpose_ros.geometry import so3
from relpose_ros.inference import bundle_adjustment
from relpose_ros.inference.bundle_adjustment import LEAST_POINTS, _Observations, _Problem, _State, refine
from relpose_ros.inference.local_features import match
from relpose_ros.inference.matches import NOTHING, TwoViewGeometry
from relpose_ros.inference.two_view_poses import RelativePose

ANGLES = [0.0, 20.0, 40.0, 60.0]


def geometries(scene, features, probability=0.95):
    """All features that match, with the true pose of each pair."""
    found = {}
    for i, j in itertools.combinations(range(len(features)), 2):
        rotation, direction = scene.relative(i, j)
        pose = RelativePose(rotation, direction, 1e-4 * np.eye(3), 1e-4 * np.eye(3), 1.0)
        found[i, j] = TwoViewGeometry((pose,), match(features[i], features[j]), probability)
    return found


def perturbed(scene, degrees=2.0, shift=0.03, seed=0):
    """Poses of which all but the first are off."""
    generator = np.random.default_rng([seed, 2])
    turns = generator.standard_normal((len(scene.rotations), 3))
    turns *= np.radians(degrees) / np.linalg.norm(turns, axis=1, keepdims=True)
    shifts = shift * generator.standard_normal(turns.shape)
    turns[0] = shifts[0] = 0
    return so3.exp(turns) @ scene.rotations, scene.translations + shifts


def rotation_error(rotations, scene):
    return np.degrees(so3.angle_between(rotations, scene.rotations)).max()


def centre_error(rotations, translations, scene):
    """Largest error of a centre once the scale about the first camera, which nothing fixes, is right."""
    found = -np.einsum("nba,nb->na", rotations, translations)
    truth = -np.einsum("nba,nb->na", scene.rotations, scene.translations)
    a, b = found - found[0], truth - truth[0]
    return np.linalg.norm(a * (a * b).sum() / (a * a).sum() - b, axis=1).max()


@pytest.mark.parametrize("seed", range(3))
def test_poses_two_degrees_off_become_exact(point_scene, seed):
    scene = point_scene.ring(ANGLES, seed=seed)
    features = scene.features(noise=0.5, seed=seed)
    rotations, translations = perturbed(scene, seed=seed)
    found = refine(rotations, translations, features, geometries(scene, features))
    assert found.moved == (0, 1, 2, 3)
    assert rotation_error(rotations, scene) > 1.9
    assert rotation_error(found.rotations, scene) < 0.3
    assert centre_error(rotations, translations, scene) > 0.03
    assert centre_error(found.rotations, found.translations, scene) < 0.012
    # Half a pixel in two directions, less what the points took up.
    assert 0.3 < found.error_after < 0.9
    assert found.error_before > 3 * found.error_after
    np.testing.assert_array_equal(found.rotations[0], rotations[0])
    np.testing.assert_array_equal(found.translations[0], translations[0])
    np.testing.assert_allclose(found.rotations, so3.project(found.rotations), atol=1e-12)


def test_the_scale_stays_about_where_it_was(point_scene):
    scene = point_scene.ring(ANGLES)
    features = scene.features()
    rotations, translations = perturbed(scene)
    found = refine(rotations, translations, features, geometries(scene, features))
    lengths = np.linalg.norm(found.translations[1:], axis=1) / np.linalg.norm(translations[1:], axis=1)
    assert np.abs(lengths - 1).max() < 0.1


def test_wrong_matches_do_not_break_it(point_scene):
    """A third of the tracks lead to anywhere in each view."""
    scene = point_scene.ring(ANGLES, points=240)
    features = scene.features(outliers=80)
    rotations, translations = perturbed(scene)
    found = refine(rotations, translations, features, geometries(scene, features))
    assert rotation_error(found.rotations, scene) < 0.4
    assert centre_error(found.rotations, found.translations, scene) < 0.02


def test_tracks_that_pass_a_view_twice_are_left_out(point_scene):
    scene = point_scene.ring(ANGLES[:3], points=30)
    features = scene.features()
    pairs = geometries(scene, features)
    whole = bundle_adjustment._shared_points({pair: g.inliers for pair, g in pairs.items()}, features)
    assert int(whole.point.max()) + 1 == 30
    assert (np.bincount(whole.point) == 3).all()
    # In one pair, the partners of two features are exchanged: both tracks meet both, in two views.
    crossed = pairs[0, 2].inliers.copy()
    crossed[[0, 1], 1] = crossed[[1, 0], 1]
    pairs[0, 2] = replace(pairs[0, 2], inliers=crossed)
    left = bundle_adjustment._shared_points({pair: g.inliers for pair, g in pairs.items()}, features)
    assert int(left.point.max()) + 1 == 28


def test_sightings_of_a_track_are_of_one_point(point_scene):
    scene = point_scene.ring(ANGLES, points=30)
    features = scene.features(noise=0.0)
    pairs = geometries(scene, features)
    seen = bundle_adjustment._shared_points({pair: g.inliers for pair, g in pairs.items()}, features)
    points, errors = bundle_adjustment._triangulate((scene.rotations, scene.translations), seen)
    assert errors.max() < 1e-3
    distances = np.linalg.norm(points[:, None] - scene.points[None], axis=-1)
    assert distances.min(1).max() < 1e-6
    assert sorted(distances.argmin(1)) == list(range(30))


def test_a_view_without_matches_stays(point_scene):
    scene = point_scene.ring(ANGLES)
    features = scene.features()
    pairs = {pair: NOTHING if 2 in pair else g for pair, g in geometries(scene, features).items()}
    rotations, translations = perturbed(scene)
    found = refine(rotations, translations, features, pairs)
    assert found.moved == (0, 1, 3)
    np.testing.assert_array_equal(found.rotations[2], rotations[2])
    np.testing.assert_array_equal(found.translations[2], translations[2])
    assert (
        rotation_error(found.rotations[[0, 1, 3]], replace(scene, rotations=scene.rotations[[0, 1, 3]])) < 0.3
    )


def test_a_camera_that_the_last_round_leaves_out_stays(point_scene):
    """Its sightings are off by tens of pixels: within the reach of the first round, not of the last."""
    left_out = 0
    for seed in range(12):
        scene = point_scene.ring(ANGLES, points=60, seed=seed)
        features = scene.features(seed=seed)
        generator = np.random.default_rng(seed)
        astray = features[3].rays + 60 * features[3].pixel * generator.uniform(-1, 1, features[3].rays.shape)
        features[3] = replace(features[3], rays=astray)
        rotations, translations = perturbed(scene, seed=seed)
        found = refine(rotations, translations, features, geometries(scene, features))
        for camera in set(range(4)) - set(range(4) if found is None else found.moved):
            left_out += 1
            np.testing.assert_array_equal(found.rotations[camera], rotations[camera])
            np.testing.assert_array_equal(found.translations[camera], translations[camera])
    assert left_out > 0


def test_of_two_groups_that_share_nothing_the_larger_moves(point_scene):
    scene = point_scene.ring([0, 20, 40, 60, 80], points=100)
    features = scene.features()
    apart = {
        pair: NOTHING if (pair[0] < 2) != (pair[1] < 2) else g
        for pair, g in geometries(scene, features).items()
    }
    rotations, translations = perturbed(scene)
    found = refine(rotations, translations, features, apart)
    assert found.moved == (2, 3, 4)
    for camera in (0, 1, 2):
        np.testing.assert_array_equal(found.rotations[camera], rotations[camera])
    for camera in (3, 4):
        truth = scene.rotations[camera] @ scene.rotations[2].T
        assert math.degrees(so3.angle_between(found.rotations[camera] @ found.rotations[2].T, truth)) < 0.5


def test_of_several_poses_only_those_near_the_cameras_hold_them_together(point_scene):
    """Matches that are surely right, of one pose or another: three in five say this one."""
    scene = point_scene.ring(ANGLES)
    features = scene.features()

    def undecided(other_deg):
        pairs = {}
        for pair, each in geometries(scene, features).items():
            (pose,) = each.poses
            other = replace(
                pose, rotation=so3.exp([0, math.radians(other_deg), 0]) @ pose.rotation, weight=0.4
            )
            pairs[pair] = replace(each, poses=(replace(pose, weight=0.6), other))
        return refine(*perturbed(scene), features, pairs).groups

    assert undecided(20) == ((0, 1, 2, 3),)
    assert undecided(60) == ((0,), (1,), (2,), (3,))


def test_too_few_points(point_scene):
    scene = point_scene.ring(ANGLES, points=LEAST_POINTS - 1)
    features = scene.features(noise=0)
    assert refine(*perturbed(scene), features, geometries(scene, features)) is None


def test_no_matches(point_scene):
    scene = point_scene.ring(ANGLES)
    features = scene.features()
    nothing = dict.fromkeys(geometries(scene, features), NOTHING)
    assert refine(*perturbed(scene), features, nothing) is None
    assert refine(*perturbed(scene), features, {}) is None


def test_matches_that_are_not_trusted_or_contradict_the_cameras(point_scene):
    scene = point_scene.ring(ANGLES)
    features = scene.features()
    assert refine(*perturbed(scene), features, geometries(scene, features, probability=0.4)) is None
    assert refine(*perturbed(scene, degrees=60), features, geometries(scene, features)) is None


def test_cameras_in_one_place_see_no_depth(point_scene):
    scene = point_scene.ring(ANGLES)
    scene.translations = np.einsum("nab,b->na", scene.rotations, scene.translations[0])
    features = scene.features()
    assert refine(scene.rotations, scene.translations, features, geometries(scene, features)) is None


def test_what_reprojects_worse_is_not_taken(point_scene, monkeypatch):
    scene = point_scene.ring(ANGLES)
    features = scene.features()
    pairs = geometries(scene, features)
    worse = perturbed(scene, degrees=0.1, shift=0.001)
    monkeypatch.setattr(bundle_adjustment, "_adjust", lambda *arguments: worse)
    assert refine(scene.rotations, scene.translations, features, pairs) is None


def test_rays_that_are_nearly_parallel_hold_no_point(point_scene):
    """Three points, each seen by two cameras from directions 0, 1 and 2 degrees apart."""
    camera, point = np.tile([0, 1], 3), np.repeat(np.arange(3), 2)
    rays = np.zeros((6, 2))
    rays[1::2, 0] = np.tan(np.radians([0.0, 1.0, 2.0]))
    seen = _Observations(camera, point, rays, np.full(6, 1 / 800))
    poses = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    seen_well = bundle_adjustment._well_seen(poses, seen, np.zeros((3, 3)))
    assert seen_well.tolist() == [False, False, False, False, True, True]


def test_wrong_matches_alone(point_scene):
    scene = point_scene.ring(ANGLES, points=60)
    features = scene.features(outliers=60)
    rotations, translations = perturbed(scene)
    found = refine(rotations, translations, features, geometries(scene, features))
    assert found is None or found.error_after < found.error_before


def test_same_bits_twice(point_scene):
    scene = point_scene.ring(ANGLES)
    features = scene.features(outliers=30)
    pairs = geometries(scene, features)
    first, second = (refine(*perturbed(scene), features, pairs) for _ in range(2))
    assert first.rotations.tobytes() == second.rotations.tobytes()
    assert first.translations.tobytes() == second.translations.tobytes()


@pytest.fixture
def problem(point_scene):
    """Three cameras that see eight points, all a little off, and its state."""
    scene = point_scene.ring(ANGLES[:3], points=8)
    camera, point = (each.reshape(-1) for each in np.meshgrid(np.arange(3), np.arange(8)))
    generator = np.random.default_rng(0)
    local = np.einsum("qab,qb->qa", scene.rotations[camera], scene.points[point]) + scene.translations[camera]
    rays = local[:, :2] / local[:, 2:] + 0.004 * generator.standard_normal((24, 2))
    seen = _Observations(camera, point, rays, np.full(24, 1 / 800))
    rotations, translations = perturbed(scene, degrees=0.5, shift=0.01)
    state = _State(rotations, translations, scene.points + 0.01 * generator.standard_normal((8, 3)))
    return _Problem(seen, 3.0, (scene.rotations, scene.translations)), state


def moved(state, step):
    """After steps of the cameras but the first (6 each), then of the points."""
    turns, shifts = np.split(step[:12].reshape(2, 6), 2, 1)
    rotations, translations = state.rotations.copy(), state.translations.copy()
    rotations[1:] = so3.exp(turns) @ rotations[1:]
    translations[1:] += shifts
    return _State(rotations, translations, state.points + step[12:].reshape(-1, 3))


def test_derivatives_are_those_of_the_cost(problem):
    """The priors' turns are taken as small: without priors, exactly."""
    problem, state = problem
    problem._prior = state.rotations, state.translations
    equations = problem.equations(state)
    found = np.concatenate([equations.camera_slopes[1:].reshape(-1), equations.point_slopes.reshape(-1)])
    for column, step in enumerate(1e-6 * np.eye(36)):
        ahead, behind = (problem.cost(moved(state, way)) for way in (step, -step))
        assert found[column] == pytest.approx((ahead - behind) / 2e-6, rel=1e-4, abs=1e-3)


def test_a_step_solves_the_normal_equations_of_everything(problem):
    """Eliminating the points gives what the whole system, put together and solved at once, gives."""
    problem, state = problem
    residuals, by_camera, by_point = problem.weighted(state)
    jacobian, target = np.zeros((60, 36)), np.zeros(60)
    for sighting, (camera, point) in enumerate(zip(problem._seen.camera, problem._seen.point, strict=True)):
        rows = slice(2 * sighting, 2 * sighting + 2)
        if camera > 0:
            jacobian[rows, 6 * camera - 6 : 6 * camera] = by_camera[sighting]
        jacobian[rows, 12 + 3 * point : 15 + 3 * point] = by_point[sighting]
        target[rows] = residuals[sighting]
    held = [1 / bundle_adjustment.ROTATION_DEVIATION] * 3 + [1 / bundle_adjustment.TRANSLATION_DEVIATION] * 3
    jacobian[48:, :12] = np.diag(held * 2)
    target[48:] = problem.prior_residuals(state).reshape(-1)
    for damping in (1e-6, 0.5):
        normal = jacobian.T @ jacobian
        normal += damping * np.diag(np.diag(normal))
        expected = moved(state, -np.linalg.solve(normal, jacobian.T @ target))
        found = problem.stepped(state, damping)
        np.testing.assert_allclose(found.rotations, expected.rotations, atol=1e-7)
        np.testing.assert_allclose(found.translations, expected.translations, atol=1e-7)
        np.testing.assert_allclose(found.points, expected.points, atol=1e-7)


def test_from_far_off_in_a_narrow_view(point_scene):
    """Nearly orthographic views, five times as narrow: a long valley to walk down."""
    scene = point_scene.ring(ANGLES)
    scene.points /= 5
    features = scene.features(noise=0.1)
    rotations, translations = perturbed(scene, degrees=4, shift=0.01)
    found = refine(rotations, translations, features, geometries(scene, features))
    assert rotation_error(rotations, scene) > 3.9
    assert rotation_error(found.rotations, scene) < 0.7


def test_the_points_say_nothing_of_where_all_cameras_are_and_of_their_unit(point_scene):
    scene = point_scene.ring(ANGLES)
    features = scene.features()
    found = refine(*perturbed(scene), features, geometries(scene, features))
    eigenvalues = np.linalg.eigvalsh(found.information)
    assert found.information.shape == (24, 24)
    np.testing.assert_allclose(found.information, found.information.T, rtol=1e-6, atol=1e-3)
    assert np.abs(eigenvalues[:7]).max() < 1e-5 * eigenvalues[7]


def test_errors_are_as_large_as_the_information_says(point_scene):
    """Features that err each for themselves: squared deviations of three numbers are three on average."""
    squares = []
    for seed in range(8):
        scene = point_scene.ring(ANGLES, seed=seed)
        features = scene.features(noise=1.0, seed=seed)
        found = refine(*perturbed(scene, 0.5, 0.01, seed), features, geometries(scene, features))
        # The first camera held, and the unit of length by a weak hold on the others' translations.
        held = found.information[6:, 6:] + np.diag(np.tile([0, 0, 0, 4.0, 4.0, 4.0], len(ANGLES) - 1))
        covariance = np.linalg.inv(held)
        for camera in range(1, len(ANGLES)):
            own = slice(6 * camera - 6, 6 * camera - 3)
            error = so3.log(scene.rotations[camera] @ found.rotations[camera].T)
            squares.append(error @ np.linalg.solve(covariance[own, own], error))
    assert 2 < np.mean(squares) < 4


def test_features_half_as_exact_tell_a_quarter_but_none_is_more_exact_than_a_third_of_a_pixel(point_scene):
    scene = point_scene.ring(ANGLES)
    told = {}
    for noise in (0.05, 0.1, 0.5, 1.0):
        features = scene.features(noise=noise)
        found = refine(*perturbed(scene), features, geometries(scene, features))
        told[noise] = np.trace(found.information)
    assert told[0.05] == pytest.approx(told[0.1], rel=0.1)
    # Larger errors weigh less in the robust loss, too.
    assert 4 < told[0.5] / told[1.0] < 8
