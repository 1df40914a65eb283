"""Anti-aliased residual network with group norm (R. Zhang, ICML 2019; He et al. 2016).

Resolution is halved by a blur beside convolutions of stride 1.
Module and attribute names are those of the released checkpoints.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import nn
from torch.nn import functional

if TYPE_CHECKING:
    from relpose_ros.network.presets import Preset


def group_norm(channels: int) -> nn.GroupNorm:
    """The group norm that takes the place of a batch norm: 8 to 32 groups, by width."""
    return nn.GroupNorm(min(32, max(8, channels // 16)), channels)


class Blur(nn.Module):
    """Binomial filter (1, 3, 3, 1) with stride 2, edges reflected. (B, C, 2h, 2w) to (B, C, h, w)."""

    filt: torch.Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        taps = np.array([1, 3, 3, 1], np.float32) / 8
        self.register_buffer("filt", torch.from_numpy(np.tile(np.outer(taps, taps), (channels, 1, 1, 1))))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Blur and halve."""
        padded = functional.pad(x, (1, 2, 1, 2), mode="reflect")
        return functional.conv2d(padded, self.filt, stride=2, groups=len(self.filt))


def _convolution(inside: int, outside: int, size: int) -> nn.Conv2d:
    return nn.Conv2d(inside, outside, size, padding=size // 2, bias=False)


def _shortcut(inside: int, outside: int, *, halve: bool) -> nn.Sequential | None:
    if not halve and inside == outside:
        return None
    blur = [Blur(inside)] if halve else []
    return nn.Sequential(*blur, _convolution(inside, outside, 1), group_norm(outside))


class Bottleneck(nn.Module):
    """Residual block 1x1, 3x3, 1x1, four times as wide outside as inside."""

    expansion = 4

    def __init__(self, inside: int, width: int, *, halve: bool) -> None:
        super().__init__()
        outside = width * self.expansion
        last = _convolution(width, outside, 1)
        self.conv1 = _convolution(inside, width, 1)
        self.bn1 = group_norm(width)
        self.conv2 = _convolution(width, width, 3)
        self.bn2 = group_norm(width)
        self.conv3 = nn.Sequential(Blur(width), last) if halve else last
        self.bn3 = group_norm(outside)
        self.downsample = _shortcut(inside, outside, halve=halve)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, inside, h, w) -> (B, outside, h, w), or half of h and w."""
        # In place: no norm's derivatives need what it gave.
        residual = functional.relu(self.bn1(self.conv1(x)), inplace=True)
        residual = functional.relu(self.bn2(self.conv2(residual)), inplace=True)
        residual = self.bn3(self.conv3(residual))
        shortcut = x if self.downsample is None else self.downsample(x)
        return functional.relu(residual.add_(shortcut), inplace=True)


class Backbone(nn.Sequential):
    """Stem (a quarter of the resolution), then stages, each of half the resolution of the one before."""

    def __init__(self, preset: Preset) -> None:
        inside = preset.stem_width
        pool = nn.Sequential(nn.MaxPool2d(2, stride=1), Blur(inside))
        stem = [
            nn.Conv2d(3, inside, 7, stride=2, padding=3, bias=False),
            group_norm(inside),
            nn.ReLU(inplace=True),
            pool,
        ]
        stages = []
        self.widths = []
        for stage, (width, depth) in enumerate(zip(preset.stage_widths, preset.stage_depths, strict=True)):
            blocks = []
            for position in range(depth):
                halve = stage > 0 and position == 0
                blocks.append(Bottleneck(inside, width, halve=halve))
                inside = width * Bottleneck.expansion
            stages.append(nn.Sequential(*blocks))
            self.widths.append(inside)
        super().__init__(*stem, *stages)
        for module in self.modules():
            # A shape alone (the meta device) has nothing to draw, and asking for it would import a compiler.
            if isinstance(module, nn.Conv2d) and not module.weight.is_meta:
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def stage_maps(self, images: torch.Tensor) -> list[torch.Tensor]:
        """The map that leaves each stage. (B, 3, S, S) -> [(B, C_k, S / 2^(k+2), S / 2^(k+2))]."""
        x = images.contiguous(memory_format=torch.channels_last)
        for layer in list(self)[: len(self) - len(self.widths)]:
            x = layer(x)
        return self.later_maps(x, -1)

    def later_maps(self, feature_map: torch.Tensor, k: int) -> list[torch.Tensor]:
        """Map k of `stage_maps`, or -1 for what leaves the stem -> those behind it."""
        x = feature_map.contiguous(memory_format=torch.channels_last)
        maps = []
        for stage in list(self)[len(self) - len(self.widths) + k + 1 :]:
            x = stage(x)
            maps.append(x)
        return maps
