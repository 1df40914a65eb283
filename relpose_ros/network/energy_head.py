"""The last part of the network, made ready for a solver that asks it for tens of thousands of rotations.

`RelPose.embed_relative` and `RelPose.pair_energies` say the same, to be trained. Here the weights are folded
once a scan, which saves operations: they are what a step uphill costs, of few rotations at a time. And the
derivatives by the rotation are written out, which takes a third of what autograd takes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn import functional

from relpose_ros.network import conventions

if TYPE_CHECKING:
    from relpose_ros.network.relpose import RelPose


class EnergyHead:
    """Energies of relative rotations ``camera_j_from_camera_i`` (optical frames), given pairs' contexts.

    A copy of the weights as they are when it is made; nothing here is differentiable by autograd.
    """

    def __init__(self, network: RelPose) -> None:
        query = network.embed_query
        activation, middle = network.layers[0], network.layers[1]
        assert isinstance(activation, nn.LeakyReLU)
        assert isinstance(middle, nn.Linear)
        self._slope = activation.negative_slope
        with torch.no_grad():
            entries = torch.eye(9, dtype=query.weight.dtype, device=query.weight.device).view(9, 3, 3)
            released = conventions.released_relative(entries).flatten(1)
            # (9, 9 F): from the entries of a rotation to the angles whose sines and cosines are embedded.
            self._angles = (released[..., None] * network.embedding.flatten().to(released.dtype)).flatten(1)
            self._query, self._query_bias = query.weight.clone(), query.bias.clone()
            self._middle, self._middle_bias = middle.weight.clone(), middle.bias.clone()
            self._last, self._last_bias = network.last_layers()

    @torch.no_grad()
    def embed(self, rotations: torch.Tensor) -> torch.Tensor:
        """What rotations contribute before a pair is known. (..., 3, 3) -> (..., H)."""
        angles = rotations.flatten(-2).to(self._angles.dtype) @ self._angles
        return functional.linear(torch.cat([angles.sin(), angles.cos()], -1), self._query, self._query_bias)

    @torch.no_grad()
    def energies(self, contexts: torch.Tensor, embeddings: torch.Tensor) -> torch.Tensor:
        """Unnormalised log-likelihoods. (P, H) with (K, H), or each pair's own (P, K, H) -> (P, K)."""
        first, second = self._hidden(contexts, embeddings)
        return self._read(second).view(first.shape[:-1])

    @torch.no_grad()
    def energies_and_gradients(
        self, contexts: torch.Tensor, rotations: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Energies and their derivatives by the entries. (P, H), (P, K, 3, 3) -> (P, K), (P, K, 3, 3)."""
        angles = rotations.flatten(-2).to(self._angles.dtype) @ self._angles
        sines, cosines = angles.sin(), angles.cos()
        embeddings = functional.linear(torch.cat([sines, cosines], -1), self._query, self._query_bias)
        first, second = self._hidden(contexts, embeddings)
        back = torch.where(second > 0, self._last, self._slope * self._last) @ self._middle
        back = back.view_as(first)
        back = torch.where(first > 0, back, self._slope * back) @ self._query
        by_sine, by_cosine = back.chunk(2, -1)
        gradients = (by_sine * cosines - by_cosine * sines) @ self._angles.T
        return self._read(second).view(first.shape[:-1]), gradients.view(rotations.shape)

    def _hidden(self, contexts: torch.Tensor, embeddings: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Both hidden layers: (P, K, H), and (P K, H) of the second."""
        first = functional.leaky_relu_(contexts[:, None] + embeddings, self._slope)
        second = torch.addmm(self._middle_bias, first.flatten(0, 1), self._middle.T)
        return first, functional.leaky_relu_(second, self._slope)

    def _read(self, second: torch.Tensor) -> torch.Tensor:
        return torch.addmm(self._last_bias, second, self._last.T)
