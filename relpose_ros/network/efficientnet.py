"""EfficientNet-Lite0 (Tan and Le, ICML 2019; the variant for devices without squeeze and excitation).

Sizes are its own, so that its public ImageNet weights fit; batch norms are folded into the convolutions.
Convolutions are padded alike on all sides. TensorFlow, where the weights come from, pads those of stride 2 on
the right and below: it samples the same features half a stride further down and right, and at the border of a
crop they are not quite those that were trained.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional


@dataclass(frozen=True)
class _Stage:
    depth: int
    width: int
    kernel: int
    stride: int
    expansion: int


_STEM_WIDTH = 32
_STAGES = (
    _Stage(1, 16, 3, 1, 1),
    _Stage(2, 24, 3, 2, 6),
    _Stage(2, 40, 5, 2, 6),
    _Stage(3, 80, 3, 2, 6),
    _Stage(3, 112, 5, 1, 6),
    _Stage(4, 192, 5, 2, 6),
    _Stage(1, 320, 3, 1, 6),
)
_LAST_OF_RESOLUTION = (1, 2, 4, 6)
"""Stages after which the map is given: at a quarter, an eighth, a 16th and a 32nd of the image's side."""


class InvertedResidual(nn.Module):
    """Expansion, depthwise convolution, projection; added to what came in where shapes allow."""

    def __init__(self, inside: int, stage: _Stage, stride: int) -> None:
        super().__init__()
        hidden = inside * stage.expansion
        self.expand = nn.Conv2d(inside, hidden, 1) if stage.expansion > 1 else None
        self.depthwise = nn.Conv2d(
            hidden, hidden, stage.kernel, stride=stride, padding=stage.kernel // 2, groups=hidden
        )
        self.project = nn.Conv2d(hidden, stage.width, 1)
        self.adds = stride == 1 and inside == stage.width

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, inside, h, w) -> (B, width, h, w), or half of h and w."""
        # In place: no convolution's derivatives need what it gave, and a third of the time goes.
        hidden = x if self.expand is None else functional.relu6(self.expand(x), inplace=True)
        out: torch.Tensor = self.project(functional.relu6(self.depthwise(hidden), inplace=True))
        return out.add_(x) if self.adds else out


class EfficientNetLite0(nn.Module):
    """Stem and seven stages; a map is given at four resolutions."""

    def __init__(self) -> None:
        super().__init__()
        self.widths = [_STAGES[position].width for position in _LAST_OF_RESOLUTION]
        self.stem = nn.Conv2d(3, _STEM_WIDTH, 3, stride=2, padding=1)
        self.stages = nn.ModuleList()
        inside = _STEM_WIDTH
        for stage in _STAGES:
            blocks = []
            for position in range(stage.depth):
                blocks.append(InvertedResidual(inside, stage, stage.stride if position == 0 else 1))
                inside = stage.width
            self.stages.append(nn.Sequential(*blocks))
        for module in self.modules():
            # Without norms, smaller weights let what an image says fade from block to block.
            if isinstance(module, nn.Conv2d) and not module.weight.is_meta:
                nn.init.kaiming_normal_(module.weight, mode="fan_in", nonlinearity="relu")
                assert module.bias is not None
                nn.init.zeros_(module.bias)

    def stage_maps(self, images: torch.Tensor) -> list[torch.Tensor]:
        """(B, 3, S, S) -> [(B, C_k, S / 2^(k+2), S / 2^(k+2))] for k = 0 to 3."""
        x = functional.relu6(self.stem(images.contiguous(memory_format=torch.channels_last)), inplace=True)
        return self._maps_from(0, x)

    def later_maps(self, feature_map: torch.Tensor, k: int) -> list[torch.Tensor]:
        """Map k of `stage_maps` -> those behind it."""
        x = feature_map.contiguous(memory_format=torch.channels_last)
        return self._maps_from(_LAST_OF_RESOLUTION[k] + 1, x)

    def pointwise_behind(self, k: int) -> list[nn.Parameter]:
        """Weights and biases of the 1x1 convolutions behind map k: nearly all the weights there are."""
        return [
            parameter
            for stage in list(self.stages)[_LAST_OF_RESOLUTION[k] + 1 :]
            for module in stage.modules()
            if isinstance(module, nn.Conv2d) and module.groups == 1
            for parameter in module.parameters()
        ]

    def _maps_from(self, first: int, x: torch.Tensor) -> list[torch.Tensor]:
        maps = []
        for position, stage in enumerate(self.stages):
            if position >= first:
                x = stage(x)
                if position in _LAST_OF_RESOLUTION:
                    maps.append(x)
        return maps
