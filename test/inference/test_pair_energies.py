from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.geometry import so3, so3_grid
from relpose_ros.inference.global_rotations import joint_scores, joint_uphill, solve
from relpose_ros.inference.pair_distribution import search
from relpose_ros.inference.pair_energies import COARSE_LEVEL, GridEmbeddings, PairEnergies
from relpose_ros.inference.rotation_evidence import FREEDOM, Peak, RotationEvidence

SHARP = math.radians(0.3)


def sharp(rotation, probability=0.95, deviation=SHARP):
    return [Peak(rotation, deviation**2 * np.eye(3), probability)]


def energies_of(scene, peaks=None, temperature=1.0):
    """Peaks by pair (i, j); pairs without any say nothing."""
    pairs = itertools.combinations(range(len(scene)), 2)
    evidence = None if peaks is None else RotationEvidence([peaks.get(pair, []) for pair in pairs])
    with torch.no_grad():
        return PairEnergies.of(scene, scene, len(scene), temperature, evidence)


def solved(scene, energies):
    with torch.no_grad():
        return solve(energies, search(energies, GridEmbeddings(scene))).rotations.numpy()


def worst_angle(a, b):
    return math.degrees(so3.angle_between(a, b).max())


def random_rotations(count, seed):
    return torch.from_numpy(so3.random_rotations(count, np.random.default_rng(seed)))


# What is added, and to what.


def test_evidence_is_added_to_the_networks_energies(fisher_scene, cameras_around):
    scene = fisher_scene(cameras_around(3, 0))
    peaks = {(0, 2): sharp(scene.relative(0, 2), 0.5, 0.3)}
    plain, both = energies_of(scene), energies_of(scene, peaks)
    pairs, rotations = torch.tensor([0, 1, 2, 1]), random_rotations(20, 0).view(4, 5, 3, 3)
    added = both.evidence(pairs, rotations)
    torch.testing.assert_close(both.at(pairs, rotations), plain.at(pairs, rotations) + added)
    assert (added[[0, 2]] == 0).all()
    assert (added[[1, 3]] != 0).any()


def test_whole_levels_some_cells_and_single_rotations_say_the_same(fisher_scene, cameras_around):
    """Evidence on the grid is blurred by half a cell: compared with itself at that blur."""
    scene = fisher_scene(cameras_around(3, 1), concentration=2.0)
    energies = energies_of(scene, {(0, 1): sharp(scene.relative(0, 1))}, temperature=3.0)
    grid = GridEmbeddings(scene)
    energies = energies.mixed(grid, 0.1)
    level = energies.on_level(grid, 1)
    cells = torch.tensor([[5, 100, 575]]).expand(3, -1)
    torch.testing.assert_close(energies.on_cells(grid, 1, cells), level.gather(1, cells))
    rotations = torch.from_numpy(np.array(so3_grid.grid(1)))
    pairs = torch.arange(3)
    sharply = energies.at(pairs, rotations.expand(3, -1, 3, 3))
    blurred = energies.evidence(pairs, rotations, so3_grid.cell_spacing(1) / 2)
    torch.testing.assert_close(
        level.double(), sharply - energies.evidence(pairs, rotations) + blurred, atol=1e-4, rtol=0
    )


@pytest.mark.parametrize("flat", [0.05, 0.5])
def test_the_mixture_is_a_density_with_a_floor(fisher_scene, cameras_around, flat):
    scene = fisher_scene(cameras_around(2, 2), concentration=8.0)
    energies = energies_of(scene, temperature=1.5)
    energies.contexts[:, 9] += 7  # energies are known up to a constant
    grid = GridEmbeddings(scene)
    mixture = energies.mixed(grid, flat)
    on_grid = mixture.on_level(grid, 1)
    assert float(mixture.on_level(grid, 3).exp().mean()) == pytest.approx(1, abs=0.03)
    lowest = mixture.at(torch.zeros(1, dtype=torch.int64), random_rotations(500, 1)[None]).min()
    assert math.log(flat) <= float(lowest) < math.log(flat) + 0.01
    # Otherwise the order of rotations stays.
    assert torch.equal(on_grid.argsort(1)[:, -20:], energies.on_level(grid, 1).argsort(1)[:, -20:])


@pytest.mark.parametrize("concentration", [20.0, 60.0])
def test_a_mixture_of_sharp_energies_is_a_density_too(fisher_scene, cameras_around, concentration):
    """Peaks of 5 to 9 degrees between centres that are 30 degrees apart."""
    scene = fisher_scene(cameras_around(8, 3), concentration)
    energies = energies_of(scene)
    grid = GridEmbeddings(scene)
    mixture = energies.mixed(grid, 0.1)
    means = mixture.on_level(grid, 3).exp().mean(1)
    torch.testing.assert_close(means, torch.ones(28), atol=0.2, rtol=0)


def test_the_mixture_knows_its_coarse_level(fisher_scene, cameras_around):
    """What it was normalised with is not evaluated again."""
    scene = fisher_scene(cameras_around(3, 2), concentration=8.0)
    energies, grid = energies_of(scene, temperature=1.5), GridEmbeddings(scene)
    mixture = energies.mixed(grid, 0.2)
    anew = replace(mixture, coarse=None).on_level(grid, COARSE_LEVEL)
    assert torch.equal(mixture.on_level(grid, COARSE_LEVEL), anew)
    scene.energies = None
    assert torch.equal(mixture.on_level(grid, COARSE_LEVEL), anew)


def test_an_infinite_temperature_silences_the_network(fisher_scene, cameras_around):
    scene = fisher_scene(cameras_around(3, 3))
    pairs, rotations = torch.arange(3), random_rotations(12, 2).view(3, 4, 3, 3)
    silent = energies_of(scene, temperature=math.inf)
    assert (silent.at(pairs, rotations) == 0).all()
    mixture = silent.mixed(GridEmbeddings(scene), 0.2)
    torch.testing.assert_close(mixture.at(pairs, rotations), torch.zeros(3, 4), atol=1e-6, rtol=0)
    peaks = {(1, 2): sharp(scene.relative(1, 2))}
    spoken = energies_of(scene, peaks, math.inf)
    torch.testing.assert_close(spoken.at(pairs, rotations), spoken.evidence(pairs, rotations))


def test_energies_with_evidence_have_slopes(fisher_scene, cameras_around):
    scene = fisher_scene(cameras_around(3, 4))
    energies = energies_of(scene, {(0, 1): sharp(scene.relative(0, 1), 0.9, 0.2)})
    energies = energies.mixed(GridEmbeddings(scene), 0.1)
    start = torch.from_numpy(so3.exp(0.05 * np.arange(9.0).reshape(1, 3, 3)) @ cameras_around(3, 4))
    scores, slopes = joint_uphill(energies, start)
    torch.testing.assert_close(scores, joint_scores(energies, start))
    for camera, axis in itertools.product(range(3), range(3)):
        step = np.zeros((1, 3, 3))
        step[0, camera, axis] = 0.01
        ends = [joint_scores(energies, torch.from_numpy(so3.exp(turn)) @ start)[0] for turn in (step, -step)]
        by_difference = float(ends[0] - ends[1]) / 0.02
        assert float(slopes[0, camera, axis]) == pytest.approx(by_difference, rel=0.02, abs=0.03)


# What the solver makes of it.


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20)
def test_a_sharp_peak_is_found_anywhere(fisher_scene_type, seed):
    """Coarse to fine from 30 degrees down to 0.3."""
    scene_type, cameras_around = fisher_scene_type
    scene = scene_type(cameras_around(2, seed))
    energies = energies_of(scene, {(0, 1): sharp(scene.relative(0, 1))}, math.inf)
    with torch.no_grad():
        found = search(energies, GridEmbeddings(scene))
    assert math.degrees(so3.angle_between(found.modes[0, 0].numpy(), scene.relative(0, 1))) < 0.2


@pytest.mark.parametrize("views", [2, 8])
@pytest.mark.parametrize("deviation", [0.4, 3.0, 8.0])
def test_a_peak_holds_its_probability_once_searched(fisher_scene, cameras_around, views, deviation):
    """However many pairs share the search: what the blur lends to other cells is not counted twice."""
    scene = fisher_scene(cameras_around(views, 1))
    peaks = {
        pair: sharp(scene.relative(*pair), 0.9, math.radians(deviation))
        for pair in itertools.combinations(range(views), 2)
    }
    energies = energies_of(scene, peaks, math.inf)
    with torch.no_grad():
        found = search(energies, GridEmbeddings(scene))
    # Of Student's t in three dimensions, by drawing from it.
    generator = np.random.default_rng(0)
    scales = np.sqrt(generator.chisquare(FREEDOM, 100_000) / FREEDOM)
    lengths = np.linalg.norm(generator.standard_normal((100_000, 3)), axis=1) / scales
    expected = 0.9 * (lengths * deviation < 15).mean()
    for pair in range(0, energies.count, 5):
        true = scene.relative(int(energies.i[pair]), int(energies.j[pair]))
        near = so3.angle_between(found.rotations[pair].numpy(), true) < math.radians(15)
        assert float(found.masses()[pair, near].sum()) == pytest.approx(expected, abs=0.03)
        assert float(found.log_normaliser()[pair].exp()) == pytest.approx(1, abs=0.16)


def test_a_sharp_peak_sharpens_what_the_network_knows(fisher_scene, cameras_around):
    """The network is 8 degrees off in every pair, one pair is pinned by matches."""
    cameras = cameras_around(3, 5)
    scene = fisher_scene(cameras, concentration=6.0)
    for i, j in itertools.combinations(range(3), 2):
        bent = so3.exp([0.14, 0, 0]) @ scene.relative(i, j)
        scene.mixtures[i, j] = [(bent, 0.0, 6.0)]
    rotations = solved(scene, energies_of(scene, {(0, 1): sharp(scene.relative(0, 1))}))[0]
    assert worst_angle(rotations[1] @ rotations[0].T, scene.relative(0, 1)) < 0.5


@pytest.mark.parametrize("learned", [True, False])
@pytest.mark.parametrize("turn", [40.0, 180.0])
def test_a_wrong_sharp_peak_is_outvoted_over_triplets(fisher_scene, cameras_around, learned, turn):
    """A repetitive texture: matches of one pair fit sharply with a turn that is not the cameras'.

    With a network that knows little, or with none.
    """
    cameras = cameras_around(4, 6)
    scene = fisher_scene(cameras, concentration=3.0)
    peaks = {pair: sharp(scene.relative(*pair)) for pair in itertools.combinations(range(4), 2)}
    lie = so3.exp([0, math.radians(turn), 0]) @ scene.relative(1, 3)
    peaks[1, 3] = sharp(lie, 0.99)
    rotations = solved(scene, energies_of(scene, peaks, 1.0 if learned else math.inf))[0]
    assert worst_angle(rotations, cameras) < 0.5
    assert math.degrees(so3.angle_between(rotations[3] @ rotations[1].T, lie)) > turn - 2


def test_peaks_that_contradict_each_other_leave_it_to_the_network(fisher_scene, cameras_around):
    """Three views, one sharp lie among three sharp peaks: any two could be right, the network says which."""
    cameras = cameras_around(3, 7)
    scene = fisher_scene(cameras, concentration=6.0)
    peaks = {pair: sharp(scene.relative(*pair), 0.9) for pair in itertools.combinations(range(3), 2)}
    peaks[0, 2] = sharp(so3.exp([0, 1.5, 0]) @ scene.relative(0, 2), 0.9)
    assert worst_angle(solved(scene, energies_of(scene, peaks))[0], cameras) < 0.5


def test_a_network_that_is_plainly_wrong_is_outvoted_once_mixed(fisher_scene, cameras_around):
    """Two pairs of which the network is sure and wrong; three others that matches pin."""
    cameras = cameras_around(4, 8)
    scene = fisher_scene(cameras)
    pinned, lies = [(0, 1), (1, 2), (2, 3)], [(0, 2), (1, 3)]
    for pair in itertools.combinations(range(4), 2):
        scene.mixtures[pair] = [(np.eye(3), 0.0, 0.0)]
    for pair in lies:
        scene.mixtures[pair] = [(so3.exp([0.4, 1.2, -0.3]) @ scene.relative(*pair), 0.0, 20.0)]
    plain = energies_of(scene, {pair: sharp(scene.relative(*pair), 0.9) for pair in pinned})
    mixed = plain.mixed(GridEmbeddings(scene), 0.2)
    assert worst_angle(solved(scene, mixed)[0], cameras) < 0.5
    assert worst_angle(solved(scene, plain)[0], cameras) > 10


def test_same_bits_twice_with_evidence(fisher_scene, cameras_around):
    scene = fisher_scene(cameras_around(4, 9), concentration=3.0)
    peaks = {(0, 1): sharp(scene.relative(0, 1)), (1, 3): sharp(scene.relative(1, 3))}
    first, second = (solved(scene, energies_of(scene, peaks)) for _ in range(2))
    assert first.tobytes() == second.tobytes()
