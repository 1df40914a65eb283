from __future__ import annotations

import gc
import math
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from relpose_ros.estimates import Evidence, Verdict
from relpose_ros.geometry import cameras, so3
from relpose_ros.inference import bundle_adjustment, camera_positions, matches, refined_poses, verdict
from relpose_ros.inference.bundle_adjustment import Refined
from relpose_ros.inference.calibration import Calibration
from relpose_ros.inference.estimator import OWN_THREADS, Estimator, ScanError, _baselines
from relpose_ros.inference.evidence import EvidenceError, EvidenceSettings
from relpose_ros.inference.matches import NOTHING, TwoViewGeometry
from relpose_ros.inference.outlines import UNSIGHTED_SIGMA, find_outline, sighted_translations, sightlines
from relpose_ros.inference.predictions import about_the_object, predicted_translations, regressed_poses
from relpose_ros.inference.two_view_poses import RelativePose
from relpose_ros.network.checkpoint import NetworkFileError, random_network, write_network
from relpose_ros.network.crops import crop_square
from relpose_ros.network.features import SceneFeatures
from relpose_ros.network.presets import PRESETS, named_preset
from relpose_ros.views import BoundingBox, Intrinsics, RobotPose, Scan, View


@pytest.fixture(scope="module")
def network():
    return random_network("compact", 1)


ALONE = EvidenceSettings("network")
LENS = Intrinsics(70, 70, 40, 30)


def picture(seed):
    pixels = np.random.default_rng(seed).integers(0, 256, (60, 80, 3), np.uint8)
    return View(pixels, BoundingBox(10, 10, 60, 50), 80, 60)


def scan(*seeds):
    return Scan("mug", tuple(picture(seed) for seed in seeds))


def whole(views):
    """The same scan of pictures that no detector has looked at."""
    boxes = [BoundingBox(0, 0, view.full_width, view.full_height) for view in views.views]
    return replace(
        views, views=tuple(replace(view, box=box) for view, box in zip(views.views, boxes, strict=True))
    )


def numbers(estimate):
    """All that an estimate says, but for the time it took."""
    parts = [estimate.score, estimate.weakest_pair, estimate.status]
    for camera in estimate.cameras:
        parts += [camera.object_from_camera.tobytes(), camera.position.tobytes(), camera.covariance.tobytes()]
    for pair in estimate.pairs:
        parts += [pair.camera_j_from_camera_i.tobytes(), pair.covariance.tobytes(), pair.entropy]
        parts += [pair.solution_probability, *(mode.weight for mode in pair.modes)]
    return parts


def test_an_estimate_of_three_views(network):
    estimate = Estimator(network).estimate(scan(0, 1, 2))
    assert estimate.object_id == "mug"
    assert [camera.view for camera in estimate.cameras] == [0, 1, 2]
    assert [(pair.i, pair.j) for pair in estimate.pairs] == [(0, 1), (0, 2), (1, 2)]
    np.testing.assert_allclose(estimate.cameras[0].object_from_camera, np.eye(3), atol=1e-12)
    assert np.linalg.norm(estimate.cameras[0].position) == pytest.approx(1)
    assert not estimate.scale_known
    assert not estimate.calibrated
    assert estimate.seconds > 0
    for camera in estimate.cameras:
        np.testing.assert_allclose(
            camera.object_from_camera, so3.project(camera.object_from_camera), atol=1e-9
        )


def test_random_weights_ask_for_one_more_view(network):
    estimate = Estimator(network, Calibration()).estimate(scan(0, 1, 2, 3))
    assert estimate.calibrated
    assert estimate.verdict is Verdict.ONE_MORE_VIEW
    assert estimate.status.startswith("one more view: pair ")


def test_score_is_the_sum_of_the_pairs_energies_of_the_network(network):
    """Asked of the network directly, in the released convention, one pair at a time."""
    estimator = Estimator(network)
    views = scan(0, 1, 2)
    estimate = estimator.estimate(views)
    with torch.no_grad():
        features = estimator._features(views)
        flip = np.diag([-1.0, -1.0, 1.0])
        released = [flip @ camera.object_from_camera.T for camera in estimate.cameras]  # transposed below
        total = 0.0
        for i, j in [(0, 1), (0, 2), (1, 2)]:
            relative = torch.from_numpy(released[i] @ released[j].T)[None].float()  # R_i^T R_j of row vectors
            total += float(network.energies(features[i], features[j], relative)[0])
    assert estimate.score == pytest.approx(total, abs=1e-4)


def test_positions_are_those_of_the_translations(network):
    estimator = Estimator(network)
    views = whole(scan(3, 4, 5))
    estimate = estimator.estimate(views)
    with torch.no_grad():
        predicted = network.optical_translations(estimator._features(views)).double().numpy()
    predicted /= np.linalg.norm(predicted[0])
    for camera, translation in zip(estimate.cameras, predicted, strict=True):
        expected = cameras.camera_centre(camera.object_from_camera.T, translation)
        np.testing.assert_allclose(camera.position, expected, atol=1e-9)


def test_same_bits_whatever_was_estimated_before(network):
    """A node sees a scan grow view by view, a replay may see several new views at once."""
    grown = Estimator(network)
    views = scan(0, 1, 2, 3).views
    for count in (2, 3):
        grown.estimate(Scan("mug", views[:count]))
    grown.estimate(scan(7, 8))
    assert numbers(grown.estimate(Scan("mug", views))) == numbers(
        Estimator(network).estimate(scan(0, 1, 2, 3))
    )


def test_each_view_is_looked_at_once_and_forgotten_with_the_view(network, monkeypatch):
    looked = []
    monkeypatch.setattr(
        network, "look", lambda images, look=network.look: looked.append(len(images)) or look(images)
    )
    estimator = Estimator(network)
    views = scan(0, 1, 2).views
    estimator.estimate(Scan("mug", views[:2]))
    estimator.estimate(Scan("mug", views))
    estimator.estimate(Scan("mug", views[1:]))
    assert looked == [1, 1, 1]
    assert len(estimator._looks) == 3
    del views
    gc.collect()
    assert len(estimator._looks) == 0


def test_other_evidence_on_the_same_weights(network):
    given = Estimator(network, CALIBRATED)
    alone = given.with_evidence(ALONE)
    assert numbers(alone.estimate(scan(0, 1))) == numbers(
        Estimator(network, CALIBRATED, ALONE).estimate(scan(0, 1))
    )
    assert alone.preset is network.preset
    assert len(given._looks) == 0


@pytest.mark.parametrize("seed", [6, 12, 31, 53])
def test_two_views_are_told_as_their_most_probable_mode(network, seed):
    """Other peaks of these pairs are higher, and narrower: without probabilities the highest one is told."""
    calibrated, plain = (
        Estimator(network, calibration, ALONE).estimate(scan(2 * seed, 2 * seed + 1))
        for calibration in (Calibration(temperature=0.02), None)
    )
    probable = calibrated.pairs[0].modes[0].camera_j_from_camera_i
    told, highest = (
        each.cameras[1].object_from_camera.T @ each.cameras[0].object_from_camera
        for each in (calibrated, plain)
    )
    assert so3.angle_between(told, probable) < math.radians(5)
    assert so3.angle_between(highest, probable) > math.radians(25)


@pytest.mark.parametrize("count", [0, 1, 9])
def test_refuses_what_no_estimate_can_be_made_of(network, count):
    with pytest.raises(ScanError, match=f"'mug' has {count} views; an estimate takes 2 to 8"):
        Estimator(network).estimate(scan(*range(count)))
    features = SceneFeatures(torch.zeros(count, network.preset.token_width), None)
    with pytest.raises(ScanError, match=f"The features are of {count} views"):
        Estimator(network).rotations(features)


def test_threads_do_not_mix_scans(network):
    estimator = Estimator(network)
    scans = [scan(0, 1), scan(2, 3), scan(4, 5)]
    alone = [numbers(Estimator(network).estimate(each)) for each in scans]
    together = [None] * len(scans)

    def work(k):
        together[k] = numbers(estimator.estimate(scans[k]))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(len(scans))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert together == alone


def test_weights_with_a_broken_calibration_are_refused(network, tmp_path):
    file = tmp_path / "broken.safetensors"
    write_network(network, file, {"calibration": "[]"})
    with pytest.raises(NetworkFileError, match=r"broken.safetensors: the calibration has no temp"):
        Estimator.from_weights(file)


def test_weights_bring_their_calibration(network, tmp_path):
    pytest.importorskip("safetensors")
    calibration = Calibration(temperature=3.0, position_sigma=(0.05, 0.1))
    write_network(network, tmp_path / "calibrated.safetensors", {"calibration": calibration.to_json()})
    write_network(network, tmp_path / "plain.safetensors")
    calibrated = Estimator.from_weights(tmp_path / "calibrated.safetensors").estimate(scan(0, 1, 2))
    plain = Estimator.from_weights(tmp_path / "plain.safetensors").estimate(scan(0, 1, 2))
    assert calibrated.calibrated
    assert not plain.calibrated
    assert calibrated.pairs[0].entropy > plain.pairs[0].entropy
    for ours, theirs in zip(calibrated.cameras, plain.cameras, strict=True):
        turn = so3.angle_between(ours.object_from_camera, theirs.object_from_camera)
        assert turn < np.radians(0.5), "a temperature moves no joint maximum"


def test_a_backbone_in_bfloat16_is_asked_for_when_weights_are_loaded(tmp_path):
    file = tmp_path / "weights.safetensors"
    residual = replace(PRESETS["compact"], backbone="residual", stage_depths=(1, 1, 1, 1))
    write_network(random_network(residual, 1), file)
    exact, lowered = (
        Estimator.from_weights(file, evidence=ALONE, backbone_in_bfloat16=lower).estimate(scan(0, 1))
        for lower in (False, True)
    )
    assert numbers(exact) != numbers(lowered)
    assert lowered.pairs[0].entropy == pytest.approx(exact.pairs[0].entropy, abs=0.05)


def test_rotations_of_features(network):
    estimator = Estimator(network)
    views = scan(0, 1, 2)
    estimate = estimator.estimate(views)
    with torch.no_grad():
        features = estimator._features(views)
    expected = np.stack([camera.object_from_camera.T for camera in estimate.cameras])
    np.testing.assert_array_equal(estimator.rotations(features), expected)


def poses(estimate):
    rotations = np.stack([camera.object_from_camera.T for camera in estimate.cameras])
    return rotations, np.stack([camera.position for camera in estimate.cameras])


def test_a_network_that_predicts_in_the_first_cameras_frame_gives_the_same_object_frame():
    """Its translations are about the first camera's place; the object's is where the axes meet."""
    network = random_network(named_preset("compact", ["first-camera"]), 1)
    rotations, centres = poses(Estimator(network, evidence=ALONE).estimate(whole(scan(0, 1, 2))))
    np.testing.assert_allclose(cameras.closest_point_to_axes(rotations, centres), np.zeros(3), atol=1e-6)
    assert np.linalg.norm(centres[0]) == pytest.approx(1)


@pytest.mark.parametrize("by_boxes", [True, False])
def test_a_calibration_chooses_what_places_the_cameras(by_boxes):
    """Either way the object is the origin: boxes, or predictions moved to where the boxes see it."""
    views = Scan(
        "mug",
        tuple(
            replace(picture(k), box=BoundingBox(5 + 10 * k, 8, 45 + 10 * k, 30), intrinsics=LENS)
            for k in range(3)
        ),
    )
    calibration = Calibration(placed_by_boxes=by_boxes)
    estimator = Estimator(random_network("compact", 1), calibration, ALONE)
    rotations, centres = poses(estimator.estimate(views))
    translations = cameras.translation_of(rotations, centres)
    outlines = [find_outline(view) for view in views.views]
    expected = sighted_translations(outlines)
    if not by_boxes:
        predicted = predicted_translations(estimator._network, estimator.features(views), rotations)
        expected = about_the_object(rotations, predicted, outlines)
    np.testing.assert_allclose(translations, expected, atol=1e-9)
    assert np.linalg.norm(translations[0]) == pytest.approx(1)


def test_a_box_tells_where_a_camera_stands_from_the_object(network, ball):
    """As exactly as the calibration says; of the whole picture nobody says where in it the object is."""
    calibration = replace(CALIBRATED, position_sigma=(0.01, 0.02))
    boxed, unboxed = (
        Estimator(network, calibration, ALONE).estimate(each).cameras[0].covariance[0, 0]
        for each in (ball, whole(ball))
    )
    assert boxed == pytest.approx(0.01**2, rel=0.1)
    assert unboxed == pytest.approx(UNSIGHTED_SIGMA[0] ** 2, rel=0.1)


# A network that regresses poses has no probabilities to tell.


@pytest.fixture(scope="module", params=[("regression",), ("regression", "first-camera")], ids="+".join)
def regressing(request):
    return random_network(named_preset("compact", request.param), 1)


def test_regressed_poses_come_through_the_same_door(regressing):
    estimator = Estimator(regressing)
    views = whole(scan(0, 1, 2))
    estimate = estimator.estimate(views)
    with torch.no_grad():
        features = estimator._features(views)
    rotations, translations = regressed_poses(regressing, features)
    np.testing.assert_array_equal(estimator.rotations(features), rotations)
    for view, camera in enumerate(estimate.cameras):
        np.testing.assert_array_equal(camera.object_from_camera, rotations[view].T)
        centre = cameras.camera_centre(rotations[view], translations[view])
        np.testing.assert_allclose(camera.position, centre, atol=1e-12)
    np.testing.assert_allclose(rotations[0], np.eye(3), atol=1e-14)
    assert so3.angle_between(rotations[1], rotations[0]) > 0.01


def test_regressed_poses_are_never_called_enough(regressing, ball):
    """Though matches agree on this scan, and somebody gave the weights a calibration."""
    estimate = Estimator(regressing, CALIBRATED).estimate(ball)
    assert not estimate.calibrated
    assert estimate.verdict is Verdict.ONE_MORE_VIEW
    assert "regresses poses and cannot say how far to trust them" in estimate.status
    for pair in estimate.pairs:
        true = estimate.cameras[pair.j].object_from_camera.T @ estimate.cameras[pair.i].object_from_camera
        np.testing.assert_allclose(pair.camera_j_from_camera_i, true, atol=1e-12)
        assert pair.evidence == Evidence.LEARNED
        assert pair.entropy == 0
    for camera in estimate.cameras[1:]:
        assert np.linalg.eigvalsh(camera.covariance)[0] > 0
        assert np.degrees(np.sqrt(np.linalg.eigvalsh(camera.covariance[3:, 3:]).min())) > 70


def test_what_is_said_of_regressed_pairs_is_the_uniform_distribution(regressing, ball):
    pair = Estimator(regressing).estimate(ball).pairs[0]
    draws = so3.log(so3.random_rotations(200_000, np.random.default_rng(0)))
    np.testing.assert_allclose(pair.covariance, draws.T @ draws / len(draws), atol=0.02)
    angles = np.linalg.norm(draws, axis=1)
    assert pair.probability_within_15_deg == pytest.approx((angles < np.radians(15)).mean(), rel=0.15)
    assert pair.modes[0].weight == pytest.approx((angles < np.radians(30)).mean(), rel=0.1)
    ((_, masses), *others) = Estimator(regressing).pair_masses(ball)
    assert len(others) == 2
    assert masses.sum() == pytest.approx(1)
    assert np.ptp(masses) == 0


def test_regressed_poses_in_metres(regressing):
    plain, metric = (
        Estimator(regressing, evidence=EvidenceSettings(first_view_distance=distance)).estimate(scan(0, 1))
        for distance in (0.0, 0.6)
    )
    np.testing.assert_allclose(metric.cameras[1].position, 0.6 * plain.cameras[1].position)
    assert metric.scale_known


# What the pictures themselves say: a ball on a turntable before a background that stays.

TURNS = (0, 20, 40)
CALIBRATED = Calibration(temperature=3.0, flat=0.1, match_trust=(-9.0, 2.2, -3.2, 1.1))


@pytest.fixture(scope="module")
def ball(ball_on_a_turntable):
    return Scan("ball", tuple(ball_on_a_turntable(turn) for turn in TURNS))


@pytest.fixture
def ball_errors(rotation_of_ball):
    truth = np.stack([rotation_of_ball(turn) @ rotation_of_ball(TURNS[0]).T for turn in TURNS])

    def errors(estimate):
        found = np.stack([camera.object_from_camera.T for camera in estimate.cameras])
        return np.degrees(so3.angle_between(found, truth))

    return errors


@pytest.fixture(scope="module")
def of_ball(network, ball):
    """Estimates of the ball, each choice of evidence made once."""
    known = {}

    def estimate(**evidence):
        chosen = EvidenceSettings(**evidence)
        if chosen not in known:
            known[chosen] = Estimator(network, CALIBRATED, chosen).estimate(ball)
        return known[chosen]

    return estimate


def estimated(network, scan, **evidence):
    return Estimator(network, CALIBRATED, EvidenceSettings(**evidence)).estimate(scan)


def test_matches_give_the_rotations_that_random_weights_cannot(of_ball, ball_errors):
    off = of_ball(use="network")
    pairs = of_ball(use="pairs")
    assert ball_errors(off).max() > 30
    assert ball_errors(pairs).max() < 1.5
    assert [pair.evidence for pair in off.pairs] == [Evidence.LEARNED] * 3
    assert [pair.evidence for pair in pairs.pairs] == [Evidence.LEARNED | Evidence.GEOMETRIC] * 3
    for with_matches, without in zip(pairs.pairs, off.pairs, strict=True):
        assert with_matches.entropy < without.entropy - 3
        assert with_matches.probability_within_15_deg > 0.8
    assert pairs.verdict is Verdict.ENOUGH
    for with_matches, without in zip(pairs.cameras[1:], off.cameras[1:], strict=True):
        assert np.trace(with_matches.covariance[:3, :3]) < 0.2 * np.trace(without.covariance[:3, :3])


def test_shared_points_refine_the_poses(of_ball, ball_errors):
    pairs, refined = (of_ball(use=use) for use in ("pairs", "refine"))
    assert ball_errors(refined).max() < 0.6
    assert numbers(refined) != numbers(pairs)
    np.testing.assert_allclose(refined.cameras[0].object_from_camera, np.eye(3), atol=1e-12)
    # The pairs' distributions are what they were; how the poses agree with them is said anew.
    for a, b in zip(refined.pairs, pairs.pairs, strict=True):
        assert a.entropy == b.entropy
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_a_refinement_that_contradicts_the_pairs_is_not_taken(network, ball, of_ball, monkeypatch):
    calls = []

    def bent(rotations, translations, *rest):
        calls.append(rotations)
        turned = np.concatenate([rotations[:1], so3.exp([0, 0.4, 0]) @ rotations[1:]])
        return Refined(turned, translations, ((0, 1, 2),), 5.0, 0.1, np.eye(18))

    monkeypatch.setattr(bundle_adjustment, "refine", bent)
    refused = estimated(network, ball, use="refine")
    assert len(calls) == 1
    assert numbers(refused) == numbers(of_ball(use="pairs"))


def test_a_camera_that_the_refinement_leaves_out_is_placed_anew_from_where_it_was(network, ball, monkeypatch):
    """By its directions to the others, once, and by none between cameras whose points tell them better."""
    placed = []

    def without_the_last(rotations, translations, *rest):
        return Refined(rotations, translations, ((0, 1),), 5.0, 0.1, np.eye(12))

    def place(centres, joint, baselines):
        placed.append((centres.copy(), [(each.i, each.j) for each in baselines]))
        return camera_positions.place(centres, joint, baselines)

    monkeypatch.setattr(bundle_adjustment, "refine", without_the_last)
    monkeypatch.setattr("relpose_ros.inference.estimator.place", place)
    estimated(network, ball, use="refine")
    (before, among_all), (after, left) = placed
    assert among_all == [(0, 1), (0, 2), (1, 2)]
    assert left == [(0, 2), (1, 2)]
    np.testing.assert_array_equal(after[2], before[2])


def test_one_guessed_focal_length_is_told_to_all_that_it_makes_uncertain(network, ball, monkeypatch):
    asked = {}

    def as_it_was(rotations, translations, *rest):
        return Refined(rotations, translations, ((0, 1, 2),), 5.0, 0.1, np.eye(18))

    def settle(*arguments, guessed):
        asked["settle"] = guessed
        return refined_poses.settle(*arguments, guessed=guessed)

    def judge(pairs, covariances, calibrated, *, guessed, seen):
        asked.update(covariances=covariances, calibrated=calibrated, judge=guessed, seen=seen)
        return verdict.judge(pairs, covariances, calibrated, guessed=guessed, seen=seen)

    monkeypatch.setattr(bundle_adjustment, "refine", as_it_was)
    monkeypatch.setattr("relpose_ros.inference.estimator.settle", settle)
    monkeypatch.setattr("relpose_ros.inference.estimator.judge", judge)
    views = (*ball.views[:2], replace(ball.views[2], intrinsics=None))
    estimate = estimated(network, Scan("ball", views), use="refine")
    assert (asked["settle"], asked["judge"], asked["calibrated"]) == (True, True, True)
    np.testing.assert_array_equal(asked["covariances"], [camera.covariance for camera in estimate.cameras])
    np.testing.assert_array_equal(asked["seen"], sightlines([find_outline(view) for view in views]))
    estimated(network, ball, use="refine")
    assert (asked["settle"], asked["judge"]) == (False, False)


def test_how_the_pairs_agree_is_said_of_the_refined_poses(network, ball, monkeypatch):
    def turned(rotations, translations, *rest):
        moved = np.concatenate([rotations[:1], so3.exp([0, 0.01, 0]) @ rotations[1:]])
        return Refined(moved, translations, ((0, 1, 2),), 5.0, 0.1, np.eye(18))

    def angles(estimate):
        """Between each pair's first mode and the poses."""
        found = np.stack([camera.object_from_camera.T for camera in estimate.cameras])
        return [
            so3.angle_between(pair.modes[0].camera_j_from_camera_i, found[pair.j] @ found[pair.i].T)
            for pair in estimate.pairs
        ]

    plain = estimated(network, ball, use="pairs")
    monkeypatch.setattr(bundle_adjustment, "refine", turned)
    refined = estimated(network, ball, use="refine")
    assert np.abs(np.subtract(angles(refined), angles(plain))).max() > 1e-3, "it was taken"
    np.testing.assert_allclose([pair.solution_angle for pair in refined.pairs], angles(refined), atol=1e-5)
    assert refined.score < plain.score


def test_directions_between_cameras_come_from_matches_that_agree_and_turn_with_the_second_camera():
    rotations = so3.exp(np.radians([[0.0, 0, 0], [0, 20, 0], [0, 40, 0]]))
    covariances = np.stack([1e-4 * (camera + 1) * np.eye(6) for camera in range(3)])

    def geometry(i, j, off_deg=0.0, probability=0.9):
        turn = so3.exp(np.radians([0, off_deg, 0])) @ rotations[j] @ rotations[i].T
        pose = RelativePose(turn, np.array([1.0, 0, 0]), np.zeros((3, 3)), np.zeros((3, 3)), 1.0)
        return TwoViewGeometry((pose,), np.zeros((0, 2), np.int64), probability)

    agreeing = {(0, 1): geometry(0, 1), (1, 2): geometry(1, 2)}
    first, second = _baselines({**agreeing, (0, 2): NOTHING}, rotations, covariances)
    for found, j in ((first, 1), (second, 2)):
        assert found.j == j
        np.testing.assert_allclose(found.direction, -rotations[j].T @ [1, 0, 0], atol=1e-12)
        assert np.trace(found.covariance) == pytest.approx(2e-4 * (j + 1))
    for doubtful in (geometry(0, 1, off_deg=15), geometry(0, 1, probability=0.4)):
        assert _baselines({(0, 1): doubtful}, rotations, covariances) == []


def test_geometry_alone(network, ball, of_ball, ball_errors):
    """The network says nothing: other weights, the same rotations and positions."""
    alone = of_ball(use="pairs", learned=False)
    assert [pair.evidence for pair in alone.pairs] == [Evidence.GEOMETRIC] * 3
    assert ball_errors(alone).max() < 1.5
    other = estimated(random_network("compact", 2), ball, use="pairs", learned=False)
    assert [pair.entropy for pair in other.pairs] == pytest.approx([pair.entropy for pair in alone.pairs])
    for a, b in zip(alone.cameras, other.cameras, strict=True):
        assert math.degrees(so3.angle_between(a.object_from_camera, b.object_from_camera)) < 0.1
        np.testing.assert_allclose(a.position, b.position, atol=2e-3)
    nothing = estimated(network, scan(0, 1), use="network", learned=False)
    assert nothing.pairs[0].evidence == Evidence(0)
    assert nothing.pairs[0].entropy == pytest.approx(0, abs=1e-6)


def test_surroundings_mislead_where_the_object_is_what_turns(of_ball, ball_errors):
    misled = of_ball(use="pairs", learned=False, surroundings=True)
    np.testing.assert_allclose(ball_errors(misled), TURNS, atol=2)


def test_no_match_no_opinion(network):
    """Pictures that share nothing: to the bit what the network alone says."""
    strangers = scan(0, 1, 2)
    assert numbers(estimated(network, strangers, use="network")) == numbers(
        estimated(network, strangers, use="refine")
    )


def test_what_the_network_may_be_plainly_wrong_about_is_mixed_in(network):
    """Half a uniform distribution: a sharp one keeps half of what is near its mode."""
    sharp, half = (
        Estimator(network, Calibration(temperature=0.02, flat=flat), EvidenceSettings(use="network"))
        .estimate(scan(0, 1))
        .pairs[0]
        for flat in (0.0, 0.5)
    )
    assert half.entropy > sharp.entropy
    assert half.probability_within_15_deg == pytest.approx(0.5 * sharp.probability_within_15_deg, rel=0.2)


def test_off_looks_for_no_features(network, ball, monkeypatch):
    def never(*arguments, **options):
        raise AssertionError

    monkeypatch.setattr(matches, "find_features", never)
    estimated(network, ball, use="network")
    with pytest.raises(AssertionError):
        estimated(network, ball, use="pairs")


def test_other_evidence_from_the_next_estimate_on(network, ball, of_ball):
    changing = Estimator(network, CALIBRATED, ALONE)
    for chosen in (
        {"use": "pairs"},
        {"use": "refine"},
        {"use": "pairs", "surroundings": True},
        {"use": "network"},
    ):
        changing.rest_on(EvidenceSettings(**chosen))
        assert numbers(changing.estimate(ball)) == numbers(of_ball(**chosen)), chosen


def test_other_evidence_keeps_the_matches_that_it_does_not_change(network, ball, monkeypatch):
    looked = []
    find = matches.find_features

    def counted(view, *rest, **options):
        looked.append(view)
        return find(view, *rest, **options)

    monkeypatch.setattr(matches, "find_features", counted)
    changing = Estimator(network, CALIBRATED, EvidenceSettings("pairs"))
    changing.estimate(ball)
    for settings, found in (
        (EvidenceSettings("refine"), 3),
        (EvidenceSettings("refine", first_view_distance=0.5), 3),
        (EvidenceSettings("refine", surroundings=True), 6),
    ):
        changing.rest_on(settings)
        changing.estimate(ball)
        assert len(looked) == found, settings


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"use": "netwrok"}, "evidence is 'netwrok'; choose among network, pairs, refine"),
        ({"first_view_distance": -1.0}, "first_view_distance is -1.0 m"),
        ({"first_view_distance": math.nan}, "first_view_distance is nan m"),
    ],
)
def test_evidence_that_there_is_not(settings, match):
    with pytest.raises(EvidenceError, match=match):
        EvidenceSettings(**settings)


@pytest.mark.parametrize("use", ["network", "refine"])
def test_a_known_distance_gives_metres(of_ball, use):
    plain = of_ball(use=use)
    metric = of_ball(use=use, first_view_distance=0.6)
    assert not plain.scale_known
    assert metric.scale_known
    assert np.linalg.norm(metric.cameras[0].position) == pytest.approx(0.6, rel=0.02)
    unit = np.repeat([0.6, 1.0], 3)
    for a, b in zip(plain.cameras, metric.cameras, strict=True):
        np.testing.assert_array_equal(a.object_from_camera, b.object_from_camera)
        np.testing.assert_allclose(b.position, 0.6 * a.position)
        np.testing.assert_allclose(b.covariance, unit[:, None] * a.covariance * unit, rtol=1e-12)
        assert np.linalg.eigvalsh(b.covariance).min() > -1e-12
    assert plain.score == metric.score
    assert plain.verdict == metric.verdict


METRES = 0.35
"""From the camera to the ball: the unit of the ball's scene."""


@pytest.fixture
def robot_of_ball(rotation_of_ball):
    """What a robot says of the cameras: as if they had moved, and the ball had stood still."""
    robot_from_object = so3.exp([1.2, -0.4, 0.3])

    def poses(deviation=0.002):
        told = []
        for turn in TURNS:
            rotation = rotation_of_ball(turn) @ rotation_of_ball(TURNS[0]).T
            centre = METRES * cameras.camera_centre(rotation, [0, 0, 1])
            covariance = np.diag(np.repeat([deviation**2, 0.01**2], 3))
            position = robot_from_object @ centre + [0.5, 0, 0.2]
            told.append(RobotPose("base", robot_from_object @ rotation.T, position, covariance))
        return tuple(told), robot_from_object

    return poses


def test_the_robots_camera_poses_give_metres_and_its_frame(network, ball, of_ball, robot_of_ball):
    poses, robot_from_object = robot_of_ball()
    plain = of_ball()
    metric = estimated(network, Scan("ball", ball.views, poses))
    assert metric.scale_known
    assert 0 < metric.scale_deviation < 0.15
    scale = np.linalg.norm(metric.cameras[0].position)
    assert abs(math.log(scale / METRES)) < 3 * metric.scale_deviation
    for a, b in zip(plain.cameras, metric.cameras, strict=True):
        np.testing.assert_array_equal(a.object_from_camera, b.object_from_camera)
        np.testing.assert_allclose(b.position, scale * a.position, rtol=1e-9)
        # The scale's own deviation lies along the position.
        alone = scale**2 * a.covariance[:3, :3]
        along = metric.scale_deviation**2 * np.outer(b.position, b.position)
        np.testing.assert_allclose(b.covariance[:3, :3], alone + along, rtol=1e-6, atol=1e-12)
        np.testing.assert_array_equal(a.covariance[3:, 3:], b.covariance[3:, 3:])
    known = metric.object_pose
    assert known.frame_id == "base"
    assert math.degrees(so3.angle_between(known.robot_from_object, robot_from_object)) < 3
    error = known.position - [0.5, 0, 0.2]
    assert error @ np.linalg.solve(known.covariance[:3, :3], error) < 16
    assert (plain.scale_known, plain.scale_deviation, plain.object_pose) == (False, 0.0, None)


def test_camera_poses_go_before_a_distance_which_goes_before_nothing(network, ball, robot_of_ball):
    poses, _ = robot_of_ball()
    of_poses = estimated(network, Scan("ball", ball.views, poses))
    both = estimated(network, Scan("ball", ball.views, poses), first_view_distance=2.0)
    np.testing.assert_array_equal(both.cameras[1].position, of_poses.cameras[1].position)
    one = Scan("ball", ball.views, (poses[0], None, None))
    distance = estimated(network, one, use="pairs", first_view_distance=2.0)
    assert distance.scale_known
    assert (distance.scale_deviation, distance.object_pose) == (0.0, None)
    assert np.linalg.norm(distance.cameras[0].position) == pytest.approx(2, rel=0.02)


def test_camera_poses_that_do_not_tell_the_scale_say_why(network, ball, of_ball, robot_of_ball):
    vague, _ = robot_of_ball(deviation=1.0)
    estimate = estimated(network, Scan("ball", ball.views, vague), use="pairs")
    assert not estimate.scale_known
    plain = of_ball(use="pairs")
    start = f"{plain.status} (the robot's camera poses do not tell the scale: the baselines tell it to "
    assert estimate.status.startswith(start)
    np.testing.assert_array_equal(estimate.cameras[1].position, plain.cameras[1].position)


def test_same_bits_with_evidence_whatever_was_estimated_before(network, ball, ball_on_a_turntable):
    grown = Estimator(network, CALIBRATED)
    grown.estimate(Scan("ball", ball.views[:2]))
    grown.estimate(scan(7, 8))
    grown.estimate(Scan("ball", ball.views[1:]))
    again = Scan("ball", tuple(ball_on_a_turntable(turn) for turn in TURNS))
    assert numbers(grown.estimate(ball)) == numbers(Estimator(network, CALIBRATED).estimate(again))


@pytest.mark.parametrize(
    ("calibration", "evidence", "learned"),
    [
        (CALIBRATED, EvidenceSettings(), True),
        (CALIBRATED, EvidenceSettings(surroundings=True), False),
        (CALIBRATED, EvidenceSettings(learned=False), False),
        (replace(CALIBRATED, match_trust=None), EvidenceSettings(), False),
        (None, EvidenceSettings(), False),
    ],
)
def test_the_networks_descriptors_help_to_match_where_they_are_known_to(
    network, ball, calibration, evidence, learned
):
    estimator = Estimator(network, calibration, evidence)
    estimator.estimate(ball)
    assert [estimator._matcher.features(view).learned for view in ball.views] == [learned] * 3


def test_a_descriptor_map_lies_where_its_crop_does(network, textured):
    """The same of a part of the picture that holds the crop."""
    box = BoundingBox(60, 50, 120, 100)
    left, top, side = crop_square(box)
    assert (left, top) != (0, 0)
    full = textured(0, box=box)
    part = replace(full, image=full.image[10:140, 30:180], origin=(30, 10))
    maps = [Estimator(network).descriptor_map(view) for view in (full, part)]
    for each in maps:
        assert (each.left, each.top, each.side) == (left, top, side)
        assert each.descriptors.shape == (64, 16, 16)
    np.testing.assert_array_equal(maps[0].descriptors, maps[1].descriptors)


def test_a_network_without_descriptors_has_no_map(textured):
    regresses = random_network(named_preset("compact", ["regression"]), 0)
    assert Estimator(regresses).descriptor_map(textured(0)) is None


def test_same_bits_when_a_view_was_looked_at_alone(network, ball):
    threads = torch.get_num_threads()
    torch.set_num_threads(2)  # one view by itself would have both
    try:
        alone, together = Estimator(network, CALIBRATED), Estimator(network, CALIBRATED)
        for view in ball.views:
            alone.descriptor_map(view)
        assert numbers(alone.estimate(ball)) == numbers(together.estimate(ball))
    finally:
        torch.set_num_threads(threads)


def test_features_once_a_view_and_matches_once_a_pair(network, ball_on_a_turntable, monkeypatch):
    looked, related = [], []
    find, relate = matches.find_features, matches.relate
    monkeypatch.setattr(
        matches, "find_features", lambda *view, **options: looked.append(1) or find(*view, **options)
    )
    monkeypatch.setattr(
        matches, "relate", lambda *both, **options: related.append(1) or relate(*both, **options)
    )
    estimator = Estimator(network, CALIBRATED)
    views = tuple(ball_on_a_turntable(turn) for turn in TURNS)
    estimator.estimate(Scan("ball", views[:2]))
    assert (len(looked), len(related)) == (2, 1)
    estimator.estimate(Scan("ball", views))
    assert (len(looked), len(related)) == (3, 3)
    estimator.estimate(Scan("ball", views[1:]))
    estimator.pair_masses(Scan("ball", views))
    assert (len(looked), len(related)) == (3, 3)
    del views
    gc.collect()
    assert len(estimator._matcher._features) == 0


def test_pair_masses_hold_what_matches_say(network, ball, of_ball):
    masses_of_pairs = Estimator(network, CALIBRATED).pair_masses(ball)
    for pair, (rotations, masses) in zip(of_ball().pairs, masses_of_pairs, strict=True):
        assert masses.sum() == pytest.approx(1)
        near = so3.angle_between(rotations, pair.camera_j_from_camera_i) < math.radians(15)
        assert masses[near].sum() == pytest.approx(pair.probability_within_15_deg, abs=0.03)


def test_weights_with_evidence(network, tmp_path, ball):
    write_network(network, tmp_path / "plain.safetensors")
    two = Scan("ball", ball.views[:2])
    off = Estimator.from_weights(tmp_path / "plain.safetensors", evidence=EvidenceSettings(use="network"))
    assert off.estimate(two).pairs[0].evidence == Evidence.LEARNED
    assert Estimator.from_weights(tmp_path / "plain.safetensors").estimate(two).pairs[0].evidence == 3


def test_no_number_of_threads_is_torchs_own():
    before = torch.get_num_threads()
    try:
        Estimator.from_weights(threads=OWN_THREADS + 1)
        assert torch.get_num_threads() == OWN_THREADS + 1
        Estimator.from_weights()
        assert torch.get_num_threads() == OWN_THREADS + 1
        Estimator.from_weights(threads=0)
        assert torch.get_num_threads() == OWN_THREADS
    finally:
        torch.set_num_threads(before)


def test_the_network_alone_does_without_opencv_and_scipy():
    program = """
import sys
sys.modules["cv2"] = sys.modules["scipy"] = None
import numpy as np
from relpose_ros.inference.estimator import Estimator, EvidenceSettings
from relpose_ros.views import BoundingBox, Scan, View
pictures = np.random.default_rng(0).integers(0, 256, (3, 40, 60, 3), dtype=np.uint8)
views = tuple(View(each, BoundingBox(10, 5, 50, 35), 60, 40) for each in pictures)
estimator = Estimator.from_weights(evidence=EvidenceSettings(use="network"))
print(len(estimator.estimate(Scan("x", views)).cameras))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.stdout == "3\n", done.stderr
