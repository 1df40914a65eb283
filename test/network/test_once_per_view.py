"""The backbone looks at each view once, however often its scan is estimated, and keeps no view alive."""

from __future__ import annotations

import gc
import weakref
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.inference.estimator import Estimator
from relpose_ros.network.checkpoint import random_network
from relpose_ros.views import BoundingBox, Scan, View

if TYPE_CHECKING:
    import torch
    from torch import nn


def some_view(seed: int) -> View:
    image = np.random.default_rng(seed).integers(0, 256, (90, 120, 3), np.uint8)
    return View(image, BoundingBox(20, 10, 100, 80), 120, 90)


def test_one_more_view_costs_one_pass_of_the_backbone() -> None:
    network = random_network("compact", 0)
    looked_at: list[int] = []

    def count(module: nn.Module, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        looked_at.append(len(inputs[0]))

    network.feature_extractor.feature_extractor.stem.register_forward_hook(count)
    estimator = Estimator(network)
    views = [some_view(seed) for seed in range(4)]
    estimator.estimate(Scan("object", tuple(views[:3])))
    assert sum(looked_at) == 3
    estimator.estimate(Scan("object", tuple(views)))
    assert sum(looked_at) == 4
    # Another order and another object: still the same views.
    estimator.estimate(Scan("other", tuple(views[::-1])))
    assert sum(looked_at) == 4

    gone = weakref.ref(views.pop())
    gc.collect()
    assert gone() is None
