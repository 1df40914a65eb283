"""Predicted poses, held to cameras whose poses are known."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.geometry import cameras, so3
from relpose_ros.inference.outlines import Outline
from relpose_ros.inference.predictions import about_the_object, predicted_translations, regressed_poses
from relpose_ros.network.checkpoint import random_network
from relpose_ros.network.presets import named_preset
from relpose_ros.network.relpose import NetworkUseError


@dataclass
class Oracle:
    """A network that predicts given poses, whatever it is shown."""

    translation_frame: str
    rotations: np.ndarray
    translations: np.ndarray

    @property
    def preset(self):
        return SimpleNamespace(translation_frame=self.translation_frame)

    def optical_translations(self, features):
        return torch.from_numpy(self.translations)

    def optical_rotations(self, features):
        return torch.from_numpy(self.rotations)


def scan(seed, views):
    """Cameras that look past an object in no special place, in no special unit. -> (N, 3, 3), (N, 3)."""
    generator = np.random.default_rng(seed)
    rotations = so3.random_rotations(views, generator)
    return rotations @ rotations[0].T, generator.normal(size=(views, 3)) * 0.3 + [0, 0, 5.0]


def boxed(seen):
    """The outlines of an object at some places in the cameras' axes. (N, 3)."""
    return [Outline(place / np.linalg.norm(place), np.full(2, 0.3)) for place in seen]


@given(seed=st.integers(0, 10_000), views=st.integers(2, 8))
@settings(max_examples=20, deadline=None)
def test_poses_are_the_same_whichever_origin_they_were_learned_about(seed, views):
    rotations, translations = scan(seed, views)
    expected, _, _ = cameras.look_at_translations(rotations, translations)
    from_first = cameras.first_camera_translations(rotations, translations)
    for oracle in (
        Oracle("look_at", rotations, 3 * expected),  # a network may miss its unit
        Oracle("first_camera", rotations, from_first),
        Oracle("first_camera", rotations, 3 * from_first + rotations @ [0.1, 0.2, 0.3]),
    ):
        np.testing.assert_allclose(predicted_translations(oracle, None, rotations), expected, atol=1e-6)
        turned, moved = regressed_poses(oracle, None)
        np.testing.assert_allclose(turned, rotations, atol=1e-12)
        np.testing.assert_allclose(moved, expected, atol=1e-6)


def test_the_origin_is_moved_to_where_the_cameras_see_the_object():
    """Their axes meet beside it: everything is where it was but for the origin and the unit."""
    rotations = so3.random_rotations(6, np.random.default_rng(0))
    rotations = rotations @ rotations[0].T
    translations = np.tile([0.0, 0, 1], (6, 1))
    seen = translations + rotations @ [0.2, -0.25, 0.1]
    moved = about_the_object(rotations, translations, boxed(seen))
    assert np.linalg.norm(moved[0]) == pytest.approx(1)
    np.testing.assert_allclose(moved, seen / np.linalg.norm(seen[0]), atol=0.01)


def test_from_cameras_close_together_the_object_stays_as_far_away_as_predicted():
    """Their lines of sight meet anywhere: a degree of error would move the origin by half the distance."""
    rotations = so3.exp(np.radians([[0, 0, 0], [0, 2, 0]]))
    translations = np.tile([0.0, 0, 1], (2, 1))
    seen = np.array([[0.1, 0, 1], [0.1 + np.radians(1), 0, 1]])
    moved = about_the_object(rotations, translations, boxed(seen))
    np.testing.assert_allclose(moved[:, 2], 1, atol=0.05)
    np.testing.assert_allclose(moved[:, 0], 0.1, atol=0.02)
    # The first is at distance one wherever the object is: how far that is, the way between them tells.
    (before, after) = (
        np.linalg.norm(np.diff(cameras.camera_centre(rotations, each), axis=0))
        for each in (translations, moved)
    )
    assert after == pytest.approx(before, rel=0.05)


def test_cameras_of_which_no_box_tells_stay_as_predicted():
    rotations, translations = scan(3, 5)
    same = about_the_object(rotations, translations, [None] * 5)
    np.testing.assert_allclose(same, translations / np.linalg.norm(translations[0]), atol=1e-12)


def test_predictions_of_nothing_are_finite():
    """Cameras in one place that look one way: no object's place is closer to their axes than theirs."""
    same = np.tile(np.eye(3), (3, 1, 1))
    for frame in ("look_at", "first_camera"):
        assert np.isfinite(predicted_translations(Oracle(frame, same, np.zeros((3, 3))), None, same)).all()


@pytest.mark.parametrize("variants", [("regression",), ("regression", "first-camera")])
@torch.no_grad()
def test_a_network_that_regresses_gives_poses(variants):
    network = random_network(named_preset("compact", variants), 0)
    features = network.encode(
        torch.randn(4, 3, 128, 128, generator=torch.Generator().manual_seed(0)), torch.zeros(4, 3)
    )
    rotations, translations = regressed_poses(network, features)
    assert rotations.dtype == translations.dtype == np.float64
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(rotations[0], np.eye(3), atol=1e-14)
    assert np.linalg.norm(translations[0]) == pytest.approx(1)


def test_a_network_that_scores_rotations_predicts_none():
    network = random_network("compact", 0)
    features = network.encode(torch.zeros(2, 3, 128, 128), torch.zeros(2, 3))
    with pytest.raises(NetworkUseError, match="use the solver"):
        regressed_poses(network, features)
