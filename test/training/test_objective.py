"""The objective: samples with the density they claim, a likelihood however it is sampled."""

import dataclasses
import math
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import camera_centre, closest_point_to_axes
from relpose_ros.network.checkpoint import random_network
from relpose_ros.network.presets import PRESETS, VARIANTS, named_preset
from relpose_ros.network.relpose import RelPose
from relpose_ros.training import objective
from relpose_ros.training.objective import Batch, Objective, ObjectiveSettings

seeds = st.integers(0, 2**32 - 1)


def batch_of(seed, scans=2, views=4):
    generator = np.random.default_rng(seed)
    rotation = so3.random_rotations(scans * views, generator).reshape(scans, views, 3, 3)
    translation = generator.normal(size=(scans, views, 3, 1)) + np.array([[0.0], [0.0], [3.0]])
    return Batch(
        torch.zeros(scans, views, 3, 8, 8),
        torch.zeros(scans, views, 3),
        np.concatenate([rotation, translation], -1),
    )


@given(seeds, st.floats(0.05, math.pi))
@settings(max_examples=20, deadline=None)
def test_near_rotations_are_within_the_ball_and_uniform_in_it(seed, angle):
    generator = np.random.default_rng(seed)
    truth = so3.random_rotations(1, generator)
    turned = so3.angle_between(objective.rotations_near(truth, 4000, angle, generator), truth[:, None])[0]
    assert turned.max() <= angle + 1e-9
    half = angle / 2
    expected = so3.ball_fraction(half) / so3.ball_fraction(angle)
    assert (turned <= half).mean() == pytest.approx(expected, abs=0.03)


@given(st.integers(1, 50), st.integers(0, 50), st.lists(st.floats(0.1, 3.0), min_size=1, max_size=3))
@settings(max_examples=30, deadline=None)
def test_the_mixture_is_a_density(uniform, near, radii):
    # Over the angle, uniform rotations have the density (1 - cos a) / pi.
    angles = (np.arange(20000) + 0.5) * math.pi / 20000
    density = np.exp(objective.mixture_log_density(angles, uniform, near, tuple(radii)))
    assert (density * (1 - np.cos(angles))).mean() == pytest.approx(1, abs=1e-3)


def test_an_energy_that_knows_nothing_scores_zero_with_uniform_samples():
    assert objective.rotation_loss(
        torch.full((3, 5, 100), 7.0), torch.zeros(3, 5, 100)
    ).item() == pytest.approx(0, abs=1e-5)


def test_with_uniform_samples_it_is_the_published_cross_entropy():
    energies = torch.randn(6, 50, generator=torch.Generator().manual_seed(0))
    published = torch.nn.functional.cross_entropy(energies, torch.zeros(6, dtype=torch.long))
    ours = objective.rotation_loss(energies, torch.zeros(6, 50))
    assert ours.item() == pytest.approx(published.item() - math.log(50), abs=1e-5)


def test_samples_near_the_truth_estimate_the_same_likelihood():
    # An energy with a peak of about 20 degrees at the truth; its likelihood by brute force.
    def energy(angle):
        return torch.from_numpy(-0.5 * (angle / 0.35) ** 2)

    generator = np.random.default_rng(1)
    truth = np.eye(3)[None]
    everywhere = so3.angle_between(so3.random_rotations(400_000, generator), np.eye(3))
    exact = math.log(np.exp(energy(everywhere).numpy()).mean())
    radii = (math.radians(60), math.radians(25))
    uniform, near = 4000, 4000
    angles = np.concatenate(
        [
            [0.0],
            so3.angle_between(so3.random_rotations(uniform, generator), np.eye(3)),
            *(
                so3.angle_between(objective.rotations_near(truth, near // 2, radius, generator)[0], np.eye(3))
                for radius in radii
            ),
        ]
    )
    log_density = torch.from_numpy(objective.mixture_log_density(angles, uniform, near, radii))
    assert objective.rotation_loss(energy(angles), log_density).item() == pytest.approx(exact, abs=0.05)


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_targets_are_those_of_the_poses(seed):
    batch = batch_of(seed)
    targets = objective.make_targets(
        batch,
        ObjectiveSettings(uniform_rotations=5, near_rotations=4, near_angles=(60.0, 20.0), pairs=3),
        np.random.default_rng(seed),
        translation_frame="look_at",
    )
    assert len(targets.i) == len(targets.j) == 3
    assert all(i < j for i, j in zip(targets.i, targets.j, strict=True))
    assert targets.near.shape == (2, 3, 4, 3, 3)
    assert targets.log_density.shape == (2, 3, 1 + 5 + 4)
    pose = batch.camera_from_world
    for scan in range(2):
        for pair, (i, j) in enumerate(zip(targets.i, targets.j, strict=True)):
            relative = pose[scan, j, :, :3] @ pose[scan, i, :, :3].T
            np.testing.assert_allclose(targets.true[scan, pair], relative, atol=1e-6)
        assert targets.translations[scan, 0].norm().item() == pytest.approx(1, abs=1e-5)
        # The origin is the point closest to the axes: there the cameras see it where they are said to.
        rotation, translation = pose[scan, :, :, :3], pose[scan, :, :, 3]
        point = closest_point_to_axes(rotation, camera_centre(rotation, translation))
        seen = rotation @ point + translation
        np.testing.assert_allclose(targets.translations[scan], seen / np.linalg.norm(seen[0]), atol=1e-5)


def test_translations_in_the_first_camera_s_frame_put_that_camera_at_the_origin():
    targets = objective.make_targets(
        batch_of(3),
        ObjectiveSettings(uniform_rotations=2),
        np.random.default_rng(0),
        translation_frame="first_camera",
    )
    np.testing.assert_allclose(targets.translations[:, 0], 0, atol=1e-6)


def test_match_loss_rewards_the_true_matches_and_ignores_what_is_not_seen_twice():
    places = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [math.nan] * 3]])
    order = [2, 0, 3, 1]
    other = places[:, order].clone()
    other[0, 0] = 5.0  # the point (2, 0, 0) is hidden in the other view
    right = torch.zeros(1, 4, 4)
    right[0, 0, 1] = right[0, 1, 3] = 50.0
    assert objective.match_loss(right, places, other, 0.1).item() == pytest.approx(0, abs=1e-4)
    ignorant = objective.match_loss(torch.zeros(1, 4, 4), places, other, 0.1)
    assert ignorant.item() == pytest.approx(math.log(4), abs=1e-4)
    changed = right.clone()
    changed[0, 2, 3:] = 0.5  # rows without a match have no say
    changed[0, 3, 0] = 9.0
    assert objective.match_loss(changed, places, other, 0.1).item() == pytest.approx(0, abs=1e-4)
    nothing = torch.full_like(places, math.nan)
    assert objective.match_loss(right, nothing, other, 0.1).item() == 0


def test_the_places_asked_of_are_on_the_object_as_far_as_there_are_any():
    generator = np.random.default_rng(0)
    places = generator.normal(size=(2, 4, 4, 4, 3)).astype(np.float32)
    places[generator.random(places.shape[:-1]) < 0.5] = np.nan
    places[1, 2] = np.nan
    batch = dataclasses.replace(batch_of(0), places=torch.from_numpy(places))
    settings = ObjectiveSettings(uniform_rotations=5, match_weight=0.5, match_places=3)
    targets = objective.make_targets(batch, settings, generator, translation_frame="look_at")
    assert targets.asked.shape == (2, 2, 6, 3)
    on_object = np.isfinite(places[..., 0]).reshape(2, 4, 16)
    for asked, views in zip(targets.asked.numpy(), (targets.i, targets.j), strict=True):
        for scan in range(2):
            for pair, view in enumerate(views):
                seen = on_object[scan, view]
                assert len(set(asked[scan, pair])) == 3
                assert seen[asked[scan, pair]].sum() == min(3, seen.sum())


def test_asked_of_all_places_a_match_costs_what_match_loss_says(tiny_preset):
    generator = np.random.default_rng(1)
    batch = dataclasses.replace(
        batch_of(1), places=torch.from_numpy(generator.normal(size=(2, 4, 4, 4, 3)).astype(np.float32))
    )
    settings = ObjectiveSettings(uniform_rotations=5, match_weight=0.5, match_radius=0.8)
    network = random_network(tiny_preset, 0)
    targets = objective.make_targets(batch, settings, generator, translation_frame="look_at")
    images = torch.from_numpy(generator.normal(size=(2, 4, 3, 32, 32)).astype(np.float32))
    with torch.no_grad():
        found = Objective(network, settings)(images, batch.crop_parameters, targets)[3]
        descriptors = network.encode(images, batch.crop_parameters).maps.flatten(-2)
        likeness = descriptors[:, targets.i].mT @ descriptors[:, targets.j]
        likeness = likeness * network.correlation.log_sharpness.exp()
        places = batch.places.flatten(2, 3)
        one, other = places[:, targets.i], places[:, targets.j]
        forth = objective.match_loss(likeness, one, other, 0.8)
        back = objective.match_loss(likeness.mT, other, one, 0.8)
    assert forth > 0.1
    assert found.item() == pytest.approx((forth + back).item() / 2, abs=1e-4)


@pytest.mark.parametrize("variants", [(), *((name,) for name in VARIANTS), ("regression", "first-camera")])
@pytest.mark.parametrize("name", PRESETS)
def test_nothing_is_left_on_the_cpu_when_the_weights_are_elsewhere(name, variants, monkeypatch):
    """On torch's device without numbers, which refuses tensors of another one as a GPU does."""
    preset = named_preset(name, variants)
    with torch.device("meta"):
        network = RelPose(preset)
    settings = ObjectiveSettings(uniform_rotations=5, near_rotations=4, match_weight=0.5)
    targets = objective.make_targets(
        batch_of(0), settings, np.random.default_rng(0), translation_frame=preset.translation_frame
    )
    if preset.correlation is not None:
        side = preset.correlation.map_side
        places = torch.zeros(2, 4, side, side, 3)
        targets = dataclasses.replace(targets, places=places, asked=torch.zeros(2, 2, 6, 3, dtype=torch.long))
    images = torch.empty(2, 4, 3, preset.image_size, preset.image_size, device="meta")
    monkeypatch.setattr(torch, "autocast", lambda device, enabled: nullcontext())  # which that device lacks
    meta = torch.device("meta")
    losses = Objective(network.to(meta), settings)(
        images, torch.empty(2, 4, 3, device="meta"), targets.to(meta)
    )
    losses[0].backward()
    assert losses.device == network.device == meta
