"""The folded head says what the network says, and its derivatives are the network's own."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from relpose_ros.geometry import so3
from relpose_ros.network.checkpoint import random_network
from relpose_ros.network.presets import named_preset
from relpose_ros.network.relpose import NetworkUseError, RelPose


@pytest.mark.parametrize("preset", ["paper", "compact"])
def test_the_folded_head_says_what_the_network_says(preset: str) -> None:
    network = random_network(preset, 4)
    width = network.preset.energy_width
    contexts = torch.randn(3, width, generator=torch.Generator().manual_seed(4))
    turned = torch.from_numpy(so3.random_rotations(15, np.random.default_rng(4))).float().view(3, 5, 3, 3)
    head = network.energy_head()
    entries = turned.clone().requires_grad_()
    embeddings = network.embed_relative(entries)
    expected = network.pair_energies(contexts, embeddings)
    (slopes,) = torch.autograd.grad(expected.sum(), entries)
    expected, embeddings = expected.detach(), embeddings.detach()
    torch.testing.assert_close(head.embed(turned), embeddings)
    torch.testing.assert_close(head.energies(contexts, embeddings), expected)
    torch.testing.assert_close(
        head.energies(contexts, embeddings[0]), network.pair_energies(contexts, embeddings[0]).detach()
    )
    energies, gradients = head.energies_and_gradients(contexts, turned)
    torch.testing.assert_close(energies, expected)
    torch.testing.assert_close(gradients, slopes)


def test_a_head_keeps_the_weights_it_was_made_with() -> None:
    network = random_network("compact", 5)
    head = network.energy_head()
    contexts = torch.randn(2, network.preset.energy_width, generator=torch.Generator().manual_seed(5))
    embeddings = head.embed(torch.eye(3).expand(4, 3, 3))
    before = head.energies(contexts, embeddings)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
    assert torch.equal(head.energies(contexts, head.embed(torch.eye(3).expand(4, 3, 3))), before)


def test_a_network_that_regresses_has_none() -> None:
    with pytest.raises(NetworkUseError):
        RelPose(named_preset("compact", ["regression"])).energy_head()
