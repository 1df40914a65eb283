"""Weights and inputs that anyone can rebuild from a seed: those of the golden values in ``../shared/golden``.

Their random energies are the hardest case for a solver: no two pairs agree on anything.
"""

from __future__ import annotations

import math
import zlib
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from relpose_ros.network.relpose import RelPose

HEAD = ("embed_feature", "embed_query", "layers.1", "layers.3", "layers.4")
"""What scores rotations, of all modules."""


@torch.no_grad()
def fill(network: RelPose, modules: tuple[str, ...] = ("",)) -> None:
    """Fills all parameters of some modules (by default of the whole network), each from its own name."""
    for prefix in modules:
        for name, parameter in network.get_submodule(prefix).named_parameters(prefix):
            seed = zlib.crc32(name.encode())
            numbers = np.random.Generator(np.random.PCG64(seed)).standard_normal(parameter.shape)
            if not name.endswith("weight"):
                numbers = 0.1 * numbers
            elif parameter.ndim > 1:
                numbers = numbers * math.sqrt(2 / math.prod(parameter.shape[1:]))
            else:
                numbers = 1 + 0.1 * numbers
            parameter.copy_(torch.from_numpy(numbers.astype(np.float32)))


@torch.no_grad()
def peak(network: RelPose) -> None:
    """Makes energies smooth over the rotations, and gives them peaks of ten nats and more."""
    octave = torch.arange(network.embed_query.in_features) % network.preset.rotation_frequencies
    network.embed_query.weight *= 2.0**-octave
    network.layers[4].weight *= 8


def inputs(seed: int, views: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Noise images (N, 3, 224, 224) and crop parameters (N, 3)."""
    generator = np.random.Generator(np.random.PCG64(seed))
    images = generator.standard_normal((1, views, 3, 224, 224)).astype(np.float32)[0]
    crops = generator.uniform(-1, 1, (1, views, 3)) * [0.5, 0.5, 0.6] + [0, 0, 1.1]
    return torch.from_numpy(images), torch.from_numpy(crops.astype(np.float32)[0])
