from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.geometry import so3
from relpose_ros.inference.pair_distribution import SearchSettings, ascend, highest_apart, search, turned
from relpose_ros.inference.pair_energies import GridEmbeddings, PairEnergies


def searched(scene, **settings):
    with torch.no_grad():
        energies = PairEnergies.of(scene, scene, len(scene))
        return energies, search(energies, GridEmbeddings(scene), SearchSettings(**settings))


def test_cells_partition_the_rotations(fisher_scene, cameras_around):
    _, found = searched(fisher_scene(cameras_around(3, 0)))
    assert float(found.log_volumes.exp().sum()) == pytest.approx(1)
    assert found.masses().sum(1).tolist() == pytest.approx([1, 1, 1])
    # A partition holds every cell once: no centre comes twice.
    for rotations in found.rotations.numpy():
        assert len(np.unique(rotations.round(9).reshape(-1, 9), axis=0)) == len(rotations)


def test_masses_are_worked_out_once(fisher_scene, cameras_around):
    _, found = searched(fisher_scene(cameras_around(3, 0)))
    assert found.masses(1.5, 0.1) is found.masses(1.5, 0.1)
    assert not torch.equal(found.masses(1.5, 0.1), found.masses(1.5))


def test_a_flat_energy_is_uniform(fisher_scene, cameras_around):
    _, found = searched(fisher_scene(cameras_around(2, 0), concentration=0.0))
    assert float(found.log_normaliser()[0]) == pytest.approx(0, abs=1e-9)
    torch.testing.assert_close(found.masses()[0].log(), found.log_volumes)


@pytest.mark.parametrize("concentration", [0.5, 3.0, 12.0])
def test_normaliser_is_that_of_the_matrix_fisher_density(fisher_scene, cameras_around, concentration):
    """The mean of exp(k (tr R - 3)) is an integral over the angle, whose density is (1 - cos w) / pi."""
    _, found = searched(fisher_scene(cameras_around(2, 1), concentration))
    angles = (np.arange(20_000) + 0.5) * math.pi / 20_000
    density = np.exp(2 * concentration * (np.cos(angles) - 1)) * (1 - np.cos(angles)) / math.pi
    exact = math.log(math.pi * density.mean())
    assert float(found.log_normaliser()[0]) == pytest.approx(exact, abs=0.08)


@given(
    seed=st.integers(0, 10_000), angle=st.floats(60, 180), concentration=st.sampled_from([12.0, 40.0, 150.0])
)
@settings(max_examples=12)
def test_both_modes_of_a_symmetric_pair_are_found(fisher_scene_type, seed, angle, concentration):
    scene_type, cameras_around = fisher_scene_type
    scene = scene_type(cameras_around(2, seed))
    axis = np.random.default_rng(seed).standard_normal(3)
    true = scene.relative(0, 1)
    other = so3.exp(math.radians(angle) * axis / np.linalg.norm(axis)) @ true
    scene.mixtures[0, 1] = [(true, 0.0, concentration), (other, -0.7, concentration)]
    _, found = searched(scene)
    first, second = found.modes[0, :2].numpy()
    assert math.degrees(so3.angle_between(first, true)) < 1
    assert math.degrees(so3.angle_between(second, other)) < 1
    assert found.mode_energies[0, 0] >= found.mode_energies[0, 1] > -math.inf


def test_peaks_keep_their_distance(fisher_scene):
    rotations = torch.from_numpy(so3.random_rotations(200, np.random.default_rng(0)))[None]
    values = torch.rand(1, 200, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    tops, heights = highest_apart(rotations, values, 5, math.radians(40))
    assert float(heights[0, 0]) == float(values.max())
    assert (heights[0].diff() <= 0).all()
    chosen = rotations[0, tops[0]].numpy()
    angles = so3.angle_between(chosen[:, None], chosen[None])
    assert angles[~np.eye(5, dtype=bool)].min() > math.radians(40)


def test_peaks_of_several_rotations_differ_in_one_of_them():
    """Solutions of three cameras, all alike but in the last one."""
    last = torch.from_numpy(so3.exp(np.radians([0.0, 5.0, 25.0, 31.0])[:, None] * np.array([0, 0, 1.0])))
    solutions = torch.eye(3, dtype=torch.float64).repeat(1, 4, 3, 1, 1)
    solutions[0, :, 2] = last
    values = torch.tensor([[2.0, 3.0, 1.0, 0.5]], dtype=torch.float64)
    tops, heights = highest_apart(solutions, values, 4, math.radians(10))
    assert tops[0, :2].tolist() == [1, 2]
    assert heights[0].tolist() == [3.0, 1.0, -math.inf, -math.inf]


def test_peaks_say_when_there_are_no_more():
    rotations = torch.eye(3, dtype=torch.float64).expand(1, 4, 3, 3)
    _, heights = highest_apart(rotations, torch.arange(4.0, dtype=torch.float64)[None], 3, math.radians(10))
    assert heights[0].tolist() == [3.0, -math.inf, -math.inf]


def test_ascent_climbs_and_never_falls():
    target = torch.from_numpy(so3.exp([0.3, -0.2, 0.4]))
    starts = torch.from_numpy(so3.random_rotations(20, np.random.default_rng(1)))

    def height(rotations):
        return torch.einsum("qab,ab->q", rotations, target)

    def uphill(rotations):
        turns = target @ rotations.mT
        skew = turns - turns.mT
        return height(rotations), torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)

    ends, heights = ascend(uphill, starts, torch.full((20,), 0.5, dtype=torch.float64), steps=60)
    assert (heights >= height(starts)).all()
    assert np.degrees(so3.angle_between(ends.numpy(), target.numpy())).max() < 1


def test_turned_is_the_exponential_times_the_rotation():
    generator = np.random.default_rng(0)
    axes = generator.standard_normal((2, 8, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    angles = np.array([0, 1e-12, 1e-5, 1e-3, 0.3, 2.0, math.pi, 5.0])
    rotations = so3.exp(generator.standard_normal((2, 8, 3)))
    vectors = axes * angles[:, None]
    found = turned(torch.from_numpy(rotations), torch.from_numpy(vectors)).numpy()
    np.testing.assert_allclose(found, so3.exp(vectors) @ rotations, atol=1e-14)
