"""The paper preset against numbers of the released implementation. A tenth of the tolerance it must keep."""

from __future__ import annotations

from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

if TYPE_CHECKING:
    from conftest import Golden


def relative_error(ours: torch.Tensor, expected: np.ndarray) -> float:
    return float(np.abs(ours.numpy() - expected).max() / np.abs(expected).max())


def test_the_recipe_was_followed(golden: Golden) -> None:
    images = golden.images.double()
    assert [images.sum().item(), images.abs().sum().item()] == pytest.approx(golden.expected["image_sum"])
    assert golden.crop_parameters.numpy() == pytest.approx(golden.expected["crop_params"])


def test_the_state_dict_is_the_released_one_name_for_name_and_shape_for_shape(golden: Golden) -> None:
    ours = {name: (list(t.shape), str(t.dtype)) for name, t in golden.network.state_dict().items()}
    released = {name: (e["shape"], f"torch.{e['dtype']}") for name, e in golden.names.items()}
    assert ours == released
    assert list(ours) == list(released)


def test_the_network_is_in_eval_mode(golden: Golden) -> None:
    assert not any(module.training for module in golden.network.modules())


@torch.no_grad()
def test_backbone(golden: Golden) -> None:
    pooled = golden.network.backbone_features(golden.images)
    assert relative_error(pooled, golden.expected["backbone"]) < 1e-5


def test_features(golden: Golden) -> None:
    assert relative_error(golden.features.tokens, golden.expected["features"]) < 1e-5
    assert golden.features.maps is None


@torch.no_grad()
def test_energies_of_all_ordered_pairs(golden: Golden) -> None:
    features = golden.features
    logits = torch.zeros(len(features), len(features), len(golden.rotations))
    for i, j in permutations(range(len(features)), 2):
        logits[i, j] = golden.network.energies(features[i], features[j], golden.rotations)
    assert relative_error(logits, golden.expected["logits"]) < 1e-5


@torch.no_grad()
def test_translations(golden: Golden) -> None:
    translations = golden.network.translations(golden.features)
    assert relative_error(translations, golden.expected["translations"]) < 1e-5


@torch.no_grad()
def test_the_joint_score_of_the_authors_solution(golden: Golden) -> None:
    """With the smooth and peaked energy that the authors' solver was run on; changed back afterwards."""
    network, features = golden.network, golden.features
    rotations = torch.from_numpy(golden.solver["rotations"])
    i, j = np.triu_indices(len(features), 1)
    smoothing = 2.0 ** -(torch.arange(144) % 8)
    network.embed_query.weight *= smoothing
    network.layers[4].weight *= 8
    try:
        embeddings = network.embed_rotations(rotations[i].mT @ rotations[j])
        score = network.pair_energies(network.pair_contexts(features, i, j), embeddings[:, None]).sum()
    finally:
        network.embed_query.weight /= smoothing
        network.layers[4].weight /= 8
    assert score.item() == pytest.approx(float(golden.solver["joint_score"]), rel=1e-5)
