from __future__ import annotations

import gc
import threading

import numpy as np
import pytest
import torch

from relpose_ros.estimates import Verdict
from relpose_ros.geometry import cameras, so3
from relpose_ros.inference.calibration import Calibration
from relpose_ros.inference.estimator import Estimator, ScanError
from relpose_ros.network.checkpoint import random_network, write_network
from relpose_ros.views import BoundingBox, Scan, View


@pytest.fixture(scope="module")
def network():
    return random_network("compact", 1)


def picture(seed):
    pixels = np.random.default_rng(seed).integers(0, 256, (60, 80, 3), np.uint8)
    return View(pixels, BoundingBox(10, 10, 60, 50), 80, 60)


def scan(*seeds):
    return Scan("mug", tuple(picture(seed) for seed in seeds))


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
    views = scan(3, 4, 5)
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


@pytest.mark.parametrize("count", [0, 1, 9])
def test_refuses_what_no_estimate_can_be_made_of(network, count):
    with pytest.raises(ScanError, match=f"'mug' has {count} views; an estimate takes 2 to 8"):
        Estimator(network).estimate(scan(*range(count)))


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


def test_weights_bring_their_calibration(network, tmp_path):
    pytest.importorskip("safetensors")
    calibration = Calibration(temperature=3.0, translation_sigma=(0.05, 0.05, 0.1))
    write_network(network, tmp_path / "calibrated.safetensors", {"calibration": calibration.to_json()})
    write_network(network, tmp_path / "plain.safetensors")
    calibrated = Estimator.from_weights(tmp_path / "calibrated.safetensors").estimate(scan(0, 1))
    plain = Estimator.from_weights(tmp_path / "plain.safetensors").estimate(scan(0, 1))
    assert calibrated.calibrated
    assert not plain.calibrated
    assert calibrated.pairs[0].entropy > plain.pairs[0].entropy
    both = [each.cameras[1].object_from_camera for each in (calibrated, plain)]
    assert so3.angle_between(*both) < np.radians(0.5), "a temperature moves no maximum"


def test_rotations_of_features(network):
    estimator = Estimator(network)
    views = scan(0, 1, 2)
    estimate = estimator.estimate(views)
    with torch.no_grad():
        features = estimator._features(views)
    expected = np.stack([camera.object_from_camera.T for camera in estimate.cameras])
    np.testing.assert_array_equal(estimator.rotations(features), expected)
