from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from relpose_ros.captures.folder import Frame, load_capture, save_capture
from relpose_ros.evaluation.match_trust import (
    LEAST_OF_EACH,
    RIGHT,
    MatchedPairs,
    fit_trust,
    measure_trust,
    observe_capture,
)
from relpose_ros.geometry import so3
from relpose_ros.inference.estimator import Estimator
from relpose_ros.inference.local_features import find_features
from relpose_ros.inference.matches import relate, trust
from relpose_ros.inference.two_view_poses import explain
from relpose_ros.network.checkpoint import random_network
from relpose_ros.views import BoundingBox, Intrinsics, View

FOCAL, SIDE = 300.0, 160
TURNS = (0.0, 14.0, 28.0)


@pytest.fixture(scope="module")
def textures():
    import cv2

    generator = np.random.default_rng(0)
    noise = [cv2.GaussianBlur(generator.standard_normal((160, 160)), (0, 0), size) for size in (1.5, 3)]
    return np.clip(128 + 50 * sum(each / each.std() for each in noise), 0, 255)


def photograph(textures, turn_deg):
    """A corner of two textured walls, the camera on its arc around it: view and (3, 4) camera_from_world."""
    rotation = so3.exp([0.05, math.radians(turn_deg - 14), 0])
    translation = np.array([0.0, 0.0, 2.0])
    column, row = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    rays = np.stack([(column - SIDE / 2) / FOCAL, (row - SIDE / 2) / FOCAL, np.ones_like(row)], -1) @ rotation
    centre = -rotation.T @ translation
    image = np.full((SIDE, SIDE), 90.0)
    for sign in (-1, 1):
        normal = np.array(
            [sign * math.sin(0.9), 0, -math.cos(0.9)]
        )  # walls z = |x| tan(0.9), met at the axis
        depth = -(centre @ normal) / (rays @ normal)
        points = centre + depth[..., None] * rays
        along = np.linalg.norm(points[..., [0, 2]], axis=-1)
        u, v = 80 + sign * 130 * along, 80 + 110 * points[..., 1]
        on = (sign * points[..., 0] > 0) & (np.abs(u - 80) < 79) & (np.abs(v - 80) < 79) & (depth > 0)
        image[on] = textures[v[on].astype(int), u[on].astype(int)]
    pixels = np.repeat(image[..., None], 3, -1).astype(np.uint8)
    camera = Intrinsics(FOCAL, FOCAL, SIDE / 2, SIDE / 2)
    view = View(pixels, BoundingBox(0, 0, SIDE, SIDE), SIDE, SIDE, intrinsics=camera)
    return view, np.concatenate([rotation, translation[:, None]], 1)


@pytest.fixture(scope="module")
def capture(textures, tmp_path_factory):
    """Three photos whose cameras are known, a fourth whose camera is not, a fifth that shows nothing."""
    frames = [Frame(*photograph(textures, turn)) for turn in TURNS]
    frames.append(Frame(photograph(textures, 20.0)[0]))
    _, pose = photograph(textures, 7.0)
    frames.append(Frame(photograph(np.full_like(textures, 90), 7.0)[0], pose))
    return save_capture(tmp_path_factory.mktemp("corner") / "corner", frames)


def test_observes_the_pairs_whose_cameras_are_known(capture):
    pairs = observe_capture(load_capture(capture.folder), masked=True)
    assert pairs.signs.shape == (3, 3)  # nothing matches the plain one
    assert pairs.right.tolist() == [True, True, True]
    assert pairs.errors.shape == (3, 3)
    assert pairs.covariances.shape == (3, 3, 3)
    assert np.linalg.norm(pairs.errors, axis=1).max() < RIGHT
    first, second = (find_features(capture.view(k)) for k in (0, 1))
    explained = explain(first, second)
    assert pairs.signs[0].tolist() == explained.support.signs.tolist()
    # By the same numbers the matches say how far to trust themselves.
    assert relate(first, second).probability == trust(explained.support)


def test_a_networks_descriptors_help_where_there_are_some(textures, tmp_path):
    """With masks: nothing stands still around the object, and SIFT is not asked alone."""
    frames = [photograph(textures, turn) for turn in TURNS]
    whole = np.ones((SIDE, SIDE), bool)
    frames = [Frame(replace(view, mask=whole), pose) for view, pose in frames]
    capture = save_capture(tmp_path / "masked", frames)
    estimator = Estimator(random_network("compact", 0))
    with_network = observe_capture(capture, estimator, masked=True)
    views = [capture.view(k) for k in (0, 1)]
    explained = explain(*(find_features(view, estimator.descriptor_map(view)) for view in views))
    assert with_network.signs[0].tolist() == explained.support.signs.tolist()
    assert with_network.signs[0].tolist() != observe_capture(capture, masked=True).signs[0].tolist()


def test_what_sift_alone_was_asked_about_is_not_fitted_as_the_networks(capture):
    """Cameras that hardly turned, without masks: something may stand still around the object."""
    estimator = Estimator(random_network("compact", 0))
    views = [capture.view(k) for k in (0, 1)]
    explained = explain(*(find_features(view, estimator.descriptor_map(view)) for view in views))
    assert not explained.support.learned
    assert (
        explained.support.signs.tolist()
        not in observe_capture(capture, estimator, masked=True).signs.tolist()
    )


def test_a_wrong_pose_on_file_counts_as_wrong(capture, textures, tmp_path):
    frames = [Frame(*photograph(textures, turn)) for turn in TURNS[:2]]
    turned = so3.exp([0, 0, 0.5]) @ frames[1].camera_from_world
    wrong = save_capture(tmp_path / "wrong", [frames[0], Frame(frames[1].view, turned)])
    pairs = observe_capture(wrong, masked=True)
    assert pairs.right.tolist() == [False]
    assert pairs.errors.shape == (0, 3)
    assert pairs.covariances.shape == (0, 3, 3)


def test_pictures_that_do_not_match_are_no_pairs(textures, tmp_path):
    plain = [Frame(*photograph(np.full_like(textures, 90), turn)) for turn in TURNS]
    pairs = observe_capture(save_capture(tmp_path / "plain", plain), masked=True)
    assert pairs.right.shape == (0,)
    assert pairs.signs.shape == (0, 3)


def matched(signs, right):
    none = np.zeros((0, 3))
    return MatchedPairs(signs, right, none, none[..., None])


def stated(coefficients, signs):
    return 1 / (1 + np.exp(-(coefficients[0] + signs @ coefficients[1:])))


@pytest.fixture(scope="module")
def drawn():
    """Pairs that are right as often as some coefficients say."""
    generator = np.random.default_rng(0)
    coefficients = np.array([-8.0, 2.0, -1.0])
    signs = np.stack([generator.uniform(2, 6, 8000), generator.normal(size=8000)], 1)
    return coefficients, matched(signs, generator.uniform(size=8000) < stated(coefficients, signs))


def test_the_regression_finds_the_coefficients_of_its_own_kind(drawn):
    coefficients, pairs = drawn
    found = np.array(fit_trust(pairs))
    np.testing.assert_allclose(found, coefficients, rtol=0.1, atol=0.1)
    # The likelihood's slope vanishes: as many are right as were said to be.
    assert stated(found, pairs.signs).mean() == pytest.approx(pairs.right.mean(), abs=1e-6)


def test_measured_on_pairs_that_are_as_often_right_as_stated(drawn):
    coefficients, pairs = drawn
    report = measure_trust(pairs, coefficients)
    assert report.pairs == 8000
    assert report.right == pytest.approx(report.stated, abs=0.02)
    assert report.expected_calibration_error < 0.03
    sure = measure_trust(pairs, coefficients + np.array([4, 0, 0]))
    assert sure.stated > report.stated + 0.2
    assert sure.expected_calibration_error == pytest.approx(sure.stated - sure.right, abs=0.01)
    assert measure_trust(matched(np.zeros((0, 2)), np.zeros(0, bool)), coefficients) is None


def test_few_pairs_make_nothing_certain():
    """Perfectly separable: without the ridge the coefficients would have no end."""
    signs = np.log(np.repeat([[10.0], [12.0], [60.0], [80.0]], LEAST_OF_EACH // 2, axis=0))
    right = np.repeat([False, True], LEAST_OF_EACH)
    found = np.array(fit_trust(matched(signs, right)))
    assert np.isfinite(found).all()
    assert (stated(found, signs)[right] > 0.8).all()
    assert (stated(found, signs)[~right] < 0.2).all()
    assert np.abs(stated(found, signs) - right).max() > 0.003


@pytest.mark.parametrize("right", [True, False])
def test_nothing_is_learned_where_hardly_any_were_right_or_hardly_any_wrong(drawn, right):
    _, pairs = drawn
    few = np.flatnonzero(pairs.right == right)[: LEAST_OF_EACH - 1]
    chosen = np.concatenate([few, np.flatnonzero(pairs.right != right)])
    assert fit_trust(matched(pairs.signs[chosen], pairs.right[chosen])) is None


def test_parts_are_joined_in_their_order(drawn):
    _, pairs = drawn
    halves = [matched(pairs.signs[part], pairs.right[part]) for part in (slice(3000), slice(3000, None))]
    joined = MatchedPairs.joined(halves)
    np.testing.assert_array_equal(joined.signs, pairs.signs)
    np.testing.assert_array_equal(joined.right, pairs.right)
