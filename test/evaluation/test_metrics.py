"""The metrics: exact on known errors, blind to what an alignment forgives, and to nothing else."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.evaluation import metrics
from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import camera_centre, translation_of

seeds = st.integers(0, 2**32 - 1)
counts = st.integers(3, 8)


def cameras(seed, count):
    generator = np.random.default_rng(seed)
    return so3.random_rotations(count, generator), generator.normal(size=(count, 3)), generator


def moved(rotations, translations, scale, turn, shift):
    """The same cameras in another world: x_world' = scale * turn @ x_world + shift."""
    centres = scale * camera_centre(rotations, translations) @ turn.T + shift
    return rotations @ turn.T, translation_of(rotations @ turn.T, centres)


@given(seeds, counts, st.floats(0.1, 10))
@settings(max_examples=30, deadline=None)
def test_nothing_is_wrong_with_the_truth_in_another_world(seed, count, scale):
    r, t, generator = cameras(seed, count)
    turn, shift = so3.random_rotations(1, generator)[0], generator.normal(size=3)
    other_r, other_t = moved(r, t, scale, turn, shift)
    assert metrics.rotation_errors(other_r, r).max() < 1e-5
    assert metrics.center_errors(other_r, other_t, r, t, 1.0).max() < 1e-7
    assert metrics.translation_errors(other_r, other_t, t, 1.0).max() < 1e-7


@given(seeds, counts, st.floats(0.1, 10))
@settings(max_examples=30, deadline=None)
def test_errors_do_not_depend_on_the_estimate_s_world(seed, count, scale):
    r, t, generator = cameras(seed, count)
    wrong_r, wrong_t = so3.random_rotations(count, generator), generator.normal(size=(count, 3))
    turn, shift = so3.random_rotations(1, generator)[0], generator.normal(size=3)
    other_r, other_t = moved(wrong_r, wrong_t, scale, turn, shift)
    for here, there in (
        (metrics.rotation_errors(wrong_r, r), metrics.rotation_errors(other_r, r)),
        (
            metrics.center_errors(wrong_r, wrong_t, r, t, 2.0),
            metrics.center_errors(other_r, other_t, r, t, 2.0),
        ),
        (
            metrics.translation_errors(wrong_r, wrong_t, t, 2.0),
            metrics.translation_errors(other_r, other_t, t, 2.0),
        ),
    ):
        np.testing.assert_allclose(there, here, atol=1e-6)


@given(seeds, counts, st.floats(0, 3.1), st.data())
@settings(max_examples=30, deadline=None)
def test_one_camera_turned_by_an_angle_shows_it_in_its_pairs_alone(seed, count, angle, data):
    r, _, generator = cameras(seed, count)
    k = data.draw(st.integers(0, count - 1))
    axis = generator.normal(size=3)
    turned = r.copy()
    turned[k] = so3.exp(angle * axis / np.linalg.norm(axis)) @ r[k]
    errors = metrics.rotation_errors(turned, r)
    assert len(errors) == count * (count - 1)
    wrong = errors > 1e-4
    assert wrong.sum() == (2 * (count - 1) if angle > 1e-5 else 0)
    np.testing.assert_allclose(errors[wrong], np.degrees(angle), atol=1e-5)


def test_the_scene_s_scale_is_the_way_to_the_furthest_camera():
    assert metrics.scene_scale([[0.0, 0, 0], [0, 0, 0], [3, 0, 0]]) == pytest.approx(2)


def test_centre_errors_by_hand():
    # Four cameras on a square; the estimate has the fourth one half a side further out.
    truth = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
    r = np.tile(np.eye(3), (4, 1, 1))
    assert metrics.scene_scale(truth) == pytest.approx(np.sqrt(2))
    errors = metrics.center_errors(r, -truth, r, -truth, np.sqrt(2))
    np.testing.assert_allclose(errors, 0, atol=1e-12)
    # Stretched to a rectangle of 4 x 2: the best similarity keeps the centre and shrinks by 0.6,
    # (trace of the covariance with the truth over the estimate's variance: (2 + 1) / (4 + 1)).
    stretched = truth * [2, 1, 1]
    errors = metrics.center_errors(r, -stretched, r, -truth, np.sqrt(2))
    np.testing.assert_allclose(errors, np.hypot(0.2, 0.4) / np.sqrt(2))


def test_translation_errors_by_hand():
    # With equal rotations a shift of the world moves all translations alike: what is left is the spread
    # about the mean after the best scale.
    r = np.tile(np.eye(3), (3, 1, 1))
    estimate = np.array([[0, 0, 0.0], [0, 0, 1], [0, 0, 5]])
    truth = np.array([[0, 0, 0.0], [0, 0, 1], [0, 0, 2]])
    # Centred: e = (-2, -1, 3), w = (-1, 0, 1): s = 5 / 14, residual w - s e = (-4, 5, -1) / 14.
    errors = metrics.translation_errors(r, estimate, truth, 2.0)
    np.testing.assert_allclose(errors, np.array([4, 5, 1]) / 14 / 2)


def test_two_centres_always_align():
    r, t, generator = cameras(5, 2)
    errors = metrics.center_errors(
        so3.random_rotations(2, generator), generator.normal(size=(2, 3)), r, t, 1.0
    )
    np.testing.assert_allclose(errors, 0, atol=1e-9)


def test_a_mirrored_estimate_is_wrong():
    r, t, _ = cameras(3, 6)
    centres = camera_centre(r, t)
    mirrored = translation_of(r, centres * [-1, 1, 1])
    assert metrics.center_errors(r, mirrored, r, t, metrics.scene_scale(centres)).max() > 0.1


def test_cameras_without_an_estimate_count_as_wrong_and_leave_the_others_alone():
    r, t, _ = cameras(7, 5)
    partial_r, partial_t = r.copy(), t.copy()
    partial_r[4], partial_t[4] = np.nan, np.nan
    rotation = metrics.rotation_errors(partial_r, r)
    assert np.isinf(rotation).sum() == 8
    assert rotation[np.isfinite(rotation)].max() < 1e-5
    center = metrics.center_errors(partial_r, partial_t, r, t, 1.0)
    assert np.isinf(center).tolist() == [False] * 4 + [True]
    assert center[:4].max() < 1e-9
    translation = metrics.translation_errors(partial_r, partial_t, t, 1.0)
    assert np.isinf(translation).tolist() == [False] * 4 + [True]
    figures = metrics.summary(rotation, center, translation)
    assert figures["rotation@5"] == pytest.approx(12 / 20)
    assert figures["center@0.1"] == pytest.approx(4 / 5)
    assert all(np.isfinite(list(figures.values())))


def test_one_camera_alone_has_no_place():
    """Anything can be moved onto it."""
    r, t, _ = cameras(9, 3)
    lone_r, lone_t = r.copy(), t.copy()
    lone_r[1:], lone_t[1:] = np.nan, np.nan
    assert np.isinf(metrics.center_errors(lone_r, lone_t, r, t, 1.0)).all()
    assert np.isinf(metrics.translation_errors(lone_r, lone_t, t, 1.0)).all()


def test_no_estimate_at_all_scores_nothing():
    r, t, _ = cameras(8, 4)
    nothing = np.full_like(r, np.nan), np.full_like(t, np.nan)
    figures = metrics.summary(
        metrics.rotation_errors(nothing[0], r),
        metrics.center_errors(*nothing, r, t, 1.0),
        metrics.translation_errors(*nothing, t, 1.0),
    )
    assert figures.pop("rotation@median") == 180
    assert set(figures.values()) == {0.0}


def test_accuracy_and_area_by_hand():
    errors = [0.0, 15.0, 30.0, 90.0]
    assert metrics.accuracy(errors, 15) == 0.5
    # 1, 0.75, 0.5 and 0 of the range 0 to 60 lie above each error.
    assert metrics.area_under_curve(errors, 60) == pytest.approx((1 + 0.75 + 0.5 + 0) / 4)


@given(st.lists(st.floats(0, 180), min_size=1, max_size=30))
@settings(max_examples=50, deadline=None)
def test_the_area_is_the_mean_accuracy_over_thresholds(errors):
    grid = (np.arange(6000) + 0.5) / 100
    brute = np.mean([metrics.accuracy(errors, threshold) for threshold in grid])
    assert metrics.area_under_curve(errors, 60) == pytest.approx(brute, abs=1e-3)
