"""The fast solver held to the published one's result and to a dense, slow search."""

from __future__ import annotations

import copy
import importlib.util
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from relpose_ros.geometry import so3
from relpose_ros.inference.global_rotations import joint_scores, solve
from relpose_ros.inference.pair_distribution import search
from relpose_ros.inference.pair_energies import GridEmbeddings, PairEnergies
from relpose_ros.network import conventions
from relpose_ros.network.encoder import octaves
from relpose_ros.network.presets import PRESETS
from relpose_ros.network.relpose import RelPose

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def benchmark(name):
    """A module of the benchmarks, which are no package that tests could import."""
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def references():
    return benchmark("references")


@pytest.fixture(scope="module")
def peaked_head():
    """The published network's energy head by the golden recipe, made smooth and peaked; no other weights."""
    recipes = benchmark("recipes")
    with torch.device("meta"):
        network = RelPose(PRESETS["paper"]).eval()
    network.embedding = octaves(PRESETS["paper"].rotation_frequencies)[None, None]
    for name in recipes.HEAD:
        network.get_submodule(name).to_empty(device="cpu")
    recipes.fill(network, recipes.HEAD)
    recipes.peak(network)
    return network


def solved(network, tokens):
    features = SimpleNamespace(tokens=tokens, maps=None)
    with torch.no_grad():
        energies = PairEnergies.of(network, features, len(tokens))
        return energies, solve(energies, search(energies, GridEmbeddings(network)))


def test_scores_at_least_what_the_authors_solver_found(peaked_head, shared):
    tokens = torch.from_numpy(np.load(shared / "golden" / "network_n4.npz")["features"])
    golden = np.load(shared / "golden" / "solver_n4.npz")
    assert json.loads((shared / "golden" / "state_dict.json").read_text())["layers.4.weight"]["shape"] == [
        1,
        256,
    ]
    energies, solutions = solved(peaked_head, tokens)
    theirs = conventions.optical_rotation(torch.from_numpy(golden["rotations"])).double()
    with torch.no_grad():
        assert float(joint_scores(energies, theirs[None])[0]) == pytest.approx(
            golden["joint_score"], abs=2e-3
        )
    assert float(solutions.scores[0]) >= golden["joint_score"]


@pytest.mark.parametrize(("seed", "views"), [(0, 2), (1, 2), (2, 3), (3, 3)])
def test_scores_at_least_what_a_dense_search_finds(peaked_head, references, seed, views):
    """Random tokens: pairs that contradict each other as much as they can."""
    tokens = torch.from_numpy(np.random.default_rng(seed).standard_normal((views, 2096)).astype(np.float32))
    energies, solutions = solved(peaked_head, tokens)
    with torch.no_grad():
        rotations, score = references.exhaustive(energies, level=2)
        assert float(joint_scores(energies, rotations[None])[0]) == pytest.approx(score, abs=1e-3)
    assert float(solutions.scores[0]) >= score - 0.05  # the height of a ripple


def test_the_references_find_a_known_optimum(fisher_scene, cameras_around, references):
    scene = fisher_scene(cameras_around(3, seed=1))
    with torch.no_grad():
        energies = PairEnergies.of(scene, scene, 3)
        dense, dense_score = references.exhaustive(energies, level=1)
        drawn, drawn_score, evaluated = references.published(energies, np.random.default_rng(0), scale=0.004)
    assert np.degrees(so3.angle_between(dense.numpy(), scene.cameras)).max() < 1
    assert dense_score == pytest.approx(0, abs=0.01)
    assert np.degrees(so3.angle_between(drawn.numpy(), scene.cameras)).max() < 25
    assert drawn_score < dense_score
    assert evaluated == 6 * 2000 + 50 * 2 * 1001


def test_published_evaluations_are_counted_as_run(references):
    scaled = references.published_evaluations(3)
    assert scaled == 6 * 500_000 + 50 * 2 * 250_001


def test_contexts_are_left_untouched(peaked_head):
    """Solving twice from the same energies gives the same bits: nothing is written in place."""
    tokens = torch.randn(3, 2096, generator=torch.Generator().manual_seed(0))
    kept = copy.deepcopy(tokens)
    first = solved(peaked_head, tokens)[1]
    second = solved(peaked_head, tokens)[1]
    assert torch.equal(tokens, kept)
    assert torch.equal(first.rotations, second.rotations)
