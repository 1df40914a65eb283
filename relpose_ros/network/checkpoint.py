"""Weights in files: opened safely, checked name for name, written with what one must know of them."""

from __future__ import annotations

import torch

from relpose_ros.network.presets import PRESETS, Preset
from relpose_ros.network.relpose import RelPose


def random_network(preset: Preset | str, seed: int) -> RelPose:
    """A network with seeded random weights, in eval mode: for tests, benchmarks, and the start of training.

    The caller's random state is left as it was.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return RelPose(PRESETS[preset] if isinstance(preset, str) else preset).eval()
