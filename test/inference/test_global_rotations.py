from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.geometry import so3
from relpose_ros.inference.global_rotations import joint_scores, solve, spanning_order
from relpose_ros.inference.pair_distribution import search
from relpose_ros.inference.pair_energies import GridEmbeddings, PairEnergies


def solved(scene):
    with torch.no_grad():
        energies = PairEnergies.of(scene, scene, len(scene))
        return energies, solve(energies, search(energies, GridEmbeddings(scene)))


def worst_angle(a, b):
    return math.degrees(so3.angle_between(a, b).max())


@pytest.mark.parametrize("views", [2, 3, 5, 8])
def test_finds_the_rotations_that_all_pairs_agree_on(fisher_scene, cameras_around, views):
    cameras = cameras_around(views, seed=views)
    _, solutions = solved(fisher_scene(cameras))
    assert worst_angle(solutions.rotations[0].numpy(), cameras) < 0.1
    assert float(solutions.scores[0]) == pytest.approx(0, abs=1e-2)


@given(
    seed=st.integers(0, 10_000), views=st.integers(2, 6), concentration=st.sampled_from([3.0, 20.0, 100.0])
)
@settings(max_examples=10)
def test_never_scores_below_the_truth(fisher_scene_type, seed, views, concentration):
    scene_type, cameras_around = fisher_scene_type
    cameras = cameras_around(views, seed)
    energies, solutions = solved(scene_type(cameras, concentration))
    with torch.no_grad():
        truth = joint_scores(energies, torch.from_numpy(cameras)[None])
    assert float(solutions.scores[0]) >= float(truth[0]) - 0.02
    np.testing.assert_allclose(solutions.rotations[0, 0].numpy(), np.eye(3), atol=1e-12)
    assert (
        so3.angle_between(solutions.rotations[0].numpy(), so3.project(solutions.rotations[0].numpy())).max()
        < 1e-9
    )


def test_one_decided_pair_decides_for_a_symmetric_object(fisher_scene, cameras_around):
    """Two modes half a turn apart in two of view 2's pairs, the wrong one higher: the third pair decides."""
    cameras = cameras_around(4, seed=3)
    scene = fisher_scene(cameras)
    for i, j in [(0, 2), (2, 3)]:
        flip = so3.exp([0, 0, math.pi])
        scene.mixtures[i, j] = [(scene.relative(i, j), -0.2, 20.0), (scene.relative(i, j) @ flip, 0.0, 20.0)]
    _, solutions = solved(scene)
    assert worst_angle(solutions.rotations[0].numpy(), cameras) < 0.5


def test_one_lying_pair_is_outvoted(fisher_scene, cameras_around):
    cameras = cameras_around(5, seed=4)
    scene = fisher_scene(cameras)
    lie = so3.exp([2.0, 0, 0]) @ scene.relative(0, 3)
    scene.mixtures[0, 3] = [(lie, 1.0, 40.0), (np.eye(3), -8.0, 0.0)]
    _, solutions = solved(scene)
    assert worst_angle(solutions.rotations[0].numpy(), cameras) < 0.5


def test_the_runner_up_of_a_wholly_symmetric_object_is_reported(fisher_scene, cameras_around):
    """Every pair of view 1 has two modes: turning that camera by half a turn is as good, bar a little."""
    cameras = cameras_around(3, seed=5)
    scene = fisher_scene(cameras)
    flip = so3.exp([0, math.pi, 0])  # of camera 1 about its own axis
    for i, j in [(0, 1), (1, 2)]:
        true = scene.relative(i, j)
        other = flip @ true if j == 1 else true @ flip
        scene.mixtures[i, j] = [(true, 0.0, 20.0), (other, -0.5, 20.0)]
    _, solutions = solved(scene)
    assert worst_angle(solutions.rotations[0].numpy(), cameras) < 0.5
    flipped = cameras.copy()
    flipped[1] = flip @ cameras[1]
    assert min(worst_angle(rotations, flipped) for rotations in solutions.rotations[1:].numpy()) < 12


@pytest.mark.parametrize("order", [[2, 0, 1, 3], [3, 2, 1, 0]])
def test_relabelling_the_views_relabels_the_answer(fisher_scene, cameras_around, order):
    scene = fisher_scene(cameras_around(4, seed=6))
    for i, j in itertools.combinations(range(4), 2):
        bent = so3.exp(0.1 * np.random.default_rng(10 * i + j).standard_normal(3)) @ scene.relative(i, j)
        scene.mixtures[i, j] = [(bent, 0.0, 20.0), (so3.exp([0, 2.5, 0]) @ bent, -1.0, 20.0)]
    _, straight = solved(scene)
    _, relabelled = solved(scene.relabelled(order))
    expected = straight.rotations[0].numpy()[order]
    assert worst_angle(relabelled.rotations[0].numpy(), expected @ expected[0].T) < 0.3
    assert float(relabelled.scores[0]) == pytest.approx(float(straight.scores[0]), abs=0.01)


def test_same_bits_twice(fisher_scene, cameras_around):
    scene = fisher_scene(cameras_around(5, seed=7), concentration=2.0)
    first, second = (solved(scene)[1] for _ in range(2))
    assert torch.equal(first.rotations, second.rotations)
    assert torch.equal(first.scores, second.scores)


def test_solutions_are_ordered_and_distinct(fisher_scene, cameras_around):
    scene = fisher_scene(cameras_around(3, seed=8))
    flip = so3.exp([0, 0, math.pi])
    for i, j in itertools.combinations(range(3), 2):
        scene.mixtures[i, j] = [(scene.relative(i, j), 0.0, 20.0), (scene.relative(i, j) @ flip, -0.1, 20.0)]
    _, solutions = solved(scene)
    assert (solutions.scores.diff() <= 0).all()
    for a, b in itertools.combinations(solutions.rotations.numpy(), 2):
        assert worst_angle(a, b) > 5


def test_spanning_order_follows_the_strongest_pairs():
    energies = PairEnergies(None, torch.zeros(6, 1), *torch.triu_indices(4, 4, 1), 4)
    # 0-1: 1, 0-2: 5, 0-3: 2, 1-2: 4, 1-3: 9, 2-3: 3
    order = spanning_order(torch.tensor([1.0, 5.0, 2.0, 4.0, 9.0, 3.0]), energies.pair_of)
    assert order == [0, 2, 1, 3]
