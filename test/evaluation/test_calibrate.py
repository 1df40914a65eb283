"""A network's calibration is fitted on posed captures and kept with its weights."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from relpose_ros.evaluation import match_trust
from relpose_ros.evaluation.calibrate import (
    LEAST_FLAT,
    VIEWS,
    _scans,
    calibrate,
    calibration_table,
    trust_line,
)
from relpose_ros.evaluation.match_trust import MatchedPairs
from relpose_ros.evaluation.protocol import EvaluationError, PosedViews
from relpose_ros.geometry.cameras import look_at, translation_of
from relpose_ros.inference.calibration import Calibration
from relpose_ros.network.checkpoint import load_network, random_network, read_metadata, write_network
from relpose_ros.network.presets import PRESETS, named_preset
from relpose_ros.views import BoundingBox, View


class Posed:
    """A capture of noise, and which of its views were asked for."""

    def __init__(self, name, count, seed):
        generator = np.random.default_rng(seed)
        centres = generator.normal(size=(count, 3))
        centres *= 3 / np.linalg.norm(centres, axis=1, keepdims=True)
        rotations = look_at(centres, np.zeros(3))
        poses = np.concatenate([rotations, translation_of(rotations, centres)[..., None]], -1)
        images = generator.integers(0, 256, (count, 32, 32, 3), dtype=np.uint8)
        self.asked = []

        def view(k):
            self.asked.append(k)
            return View(images[k], BoundingBox(4, 4, 28, 28), 32, 32)

        self.views = PosedViews(name, poses, view)


@pytest.fixture
def overconfident(tmp_path):
    """Weights of a network that knows nothing and is sure of it."""
    network = random_network("compact", 0)
    with torch.no_grad():
        network.layers[4].weight *= 200
    file = tmp_path / "sure.safetensors"
    write_network(network, file, {"source": "a test", "images_seen": "12", "calibration": "{}"})
    return file


def test_a_sure_and_ignorant_network_becomes_modest(overconfident, tmp_path):
    output = tmp_path / "modest.safetensors"
    found = calibrate({"noise": [Posed("noise", 9, 0).views]}, overconfident, output, scans=3, progress=False)
    calibration = found.calibration
    before, after = found.reports["noise"]
    assert before.pairs == sum(math.comb(VIEWS[k % len(VIEWS)], 2) for k in range(3, 6))  # after three to fit
    assert before.log_likelihood < -1
    assert after.log_likelihood > before.log_likelihood + 1
    assert after.log_likelihood > -0.3
    assert calibration.flat >= LEAST_FLAT
    assert "noise" in calibration_table(found.reports)
    # Nothing matches in noise.
    assert calibration.match_trust is found.trust is None
    assert trust_line(found.trust).startswith("SIFT will match alone")

    metadata = read_metadata(output)
    assert Calibration.from_json(metadata["calibration"]) == calibration != Calibration()
    assert (metadata["source"], metadata["images_seen"]) == ("a test", "12")
    written = load_network(output).state_dict()
    for name, tensor in load_network(overconfident).state_dict().items():
        torch.testing.assert_close(written[name], tensor, rtol=0, atol=0)


def test_groups_count_the_same_however_many_captures_they_have(overconfident, tmp_path):
    many, one = [Posed(f"capture {k}", 4, k) for k in range(2)], Posed("alone", 4, 9)
    groups = {"many": [each.views for each in many], "one": [one.views]}
    reports = calibrate(
        groups, overconfident, tmp_path / "a.safetensors", scans=2, half=True, progress=False
    ).reports
    assert sum(len(each.asked) for each in many) == len(one.asked) == 3 + 4 + 4 + 4  # of four photos each
    assert min(len(each.asked) for each in many) >= 7
    assert reports.keys() == groups.keys()


def test_how_far_its_descriptors_matches_are_to_be_trusted_is_kept_with_the_weights(
    overconfident, tmp_path, monkeypatch
):
    generator = np.random.default_rng(0)
    asked = []

    def observed(views, rotations, estimator):
        assert len(views) == len(rotations)
        asked.append(estimator)
        signs = generator.normal(size=(400, 3))
        right = generator.uniform(size=400) < 1 / (1 + np.exp(-signs.sum(1)))
        return MatchedPairs(signs, right, np.zeros((0, 3)), np.zeros((0, 3, 3)))

    monkeypatch.setattr(match_trust, "observe", observed)
    output = tmp_path / "out.safetensors"
    found = calibrate({"noise": [Posed("noise", 5, 0).views]}, overconfident, output, scans=6, progress=False)
    assert len(asked) == 12
    assert all(estimator.preset.name == "compact" for estimator in asked)
    trust = found.calibration.match_trust
    np.testing.assert_allclose(trust, [0, 1, 1, 1], atol=0.25)
    assert Calibration.from_json(read_metadata(output)["calibration"]).match_trust == trust
    assert found.trust.pairs == 6 * 400  # others than it was fitted on
    assert found.trust.expected_calibration_error < 0.05
    assert "of 2400 pairs" in trust_line(found.trust)


def test_a_network_without_descriptors_leaves_sift_alone(tmp_path):
    file = tmp_path / "plain.safetensors"
    preset = replace(PRESETS["compact"], correlation=None)
    write_network(random_network(preset, 0), file)
    posed = Posed("noise", 4, 0)
    found = calibrate({"noise": [posed.views]}, file, tmp_path / "out.safetensors", scans=1, progress=False)
    assert found.calibration.match_trust is None


@pytest.mark.parametrize("captures", [1, 3, 4, 60])
def test_numbers_of_views_take_turns_however_many_captures_there_are(captures):
    posed = [Posed(f"capture {k}", 9, k).views for k in range(captures)]
    drawn = list(itertools.islice(_scans(posed, 0), 24))
    assert [len(order) for _, order in drawn] == list(VIEWS) * 6
    names = [capture.name for capture, _ in drawn]
    most, least = max(map(names.count, names)), min(map(names.count, names))
    assert most - least <= 1
    assert len({(capture.name, *order) for capture, order in drawn}) == 24
    if captures > 24:
        assert names != sorted(names)  # not those alone whose names come first
        assert drawn[0][0].name != next(_scans(posed, 1))[0].name


@pytest.mark.parametrize(
    ("groups", "scans", "told"),
    [
        ({}, 1, "no capture"),
        ({"empty": []}, 1, "no capture"),
        ({"x": [Posed("x", 3, 0).views]}, 0, "0 scans"),
    ],
)
def test_nothing_to_fit_on(groups, scans, told, overconfident, tmp_path):
    with pytest.raises(EvaluationError, match=told):
        calibrate(groups, overconfident, tmp_path / "out.safetensors", scans=scans, progress=False)


def test_a_network_without_probabilities(tmp_path):
    file = tmp_path / "regression.safetensors"
    write_network(random_network(named_preset("compact", ["regression"]), 0), file)
    with pytest.raises(EvaluationError, match="regresses poses"):
        calibrate({"x": [Posed("x", 3, 0).views]}, file, tmp_path / "out.safetensors", progress=False)


def test_where_nothing_can_be_written_nothing_is_done(overconfident, tmp_path):
    posed = Posed("x", 3, 0)
    with pytest.raises(EvaluationError, match="no folder"):
        calibrate({"x": [posed.views]}, overconfident, tmp_path / "no" / "out.safetensors", progress=False)
    assert not posed.asked
