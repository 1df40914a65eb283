"""From crops to tokens: per view, the backbone; across views, the transformer.

Module and attribute names are those of the released checkpoints.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from relpose_ros.network.backbone import Backbone, group_norm
from relpose_ros.network.efficientnet import EfficientNetLite0

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from relpose_ros.network.presets import CorrelationSettings, Preset


def octaves(count: int) -> torch.Tensor:
    """The frequencies 1, 2, 4, ... (count,) int64."""
    return torch.tensor([2**power for power in range(count)])


def fourier(values: torch.Tensor, frequencies: torch.Tensor) -> torch.Tensor:
    """Sines, then cosines, of each value times each frequency. (..., V), (F,) -> (..., 2 V F)."""
    angles = (values[..., None] * frequencies.to(values.dtype)).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], -1)


class IndexEncoding(nn.Module):
    """Sinusoidal encoding of a view's position in the scan (Vaswani et al. 2017), base 10000."""

    pos_table_1: torch.Tensor

    def __init__(self, views: int, width: int) -> None:
        super().__init__()
        self.register_buffer("pos_table_1", self.table(views, width))

    @staticmethod
    def table(views: int, width: int) -> torch.Tensor:
        """(1, views, width): sines at even, cosines at odd columns, wavelengths up to 2 pi times 10000."""
        column = np.arange(width)
        angles = np.arange(views)[:, None] / 10000 ** (2 * (column // 2) / width)
        return torch.from_numpy(np.where(column % 2 == 0, np.sin(angles), np.cos(angles))).float()[None]

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        """(..., N, D) -> the same, each token shifted by its row of the table."""
        return tokens + self.pos_table_1[0, : tokens.shape[-2]]


class Attention(nn.Module):
    """Multi-head self-attention without biases before the softmax."""

    def __init__(self, width: int, heads: int, head_width: int) -> None:
        super().__init__()
        self.heads = heads
        self.to_qkv = nn.Linear(width, 3 * heads * head_width, bias=False)
        self.to_out = nn.Sequential(nn.Linear(heads * head_width, width))

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        """(..., N, D) -> (..., N, D)."""
        qkv = self.to_qkv(tokens).unflatten(-1, (3, self.heads, -1)).transpose(-4, -2)
        q, k, v = qkv.unbind(-3)  # (..., heads, N, head width)
        attended = functional.scaled_dot_product_attention(q, k, v)
        out: torch.Tensor = self.to_out(attended.transpose(-3, -2).flatten(-2))
        return out


class FeedForward(nn.Module):
    """Two linear layers with a GELU between them; the gap in the numbering is the published dropout."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(width, hidden), nn.GELU(), nn.Identity(), nn.Linear(hidden, width))

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        """(..., N, D) -> (..., N, D)."""
        out: torch.Tensor = self.net(tokens)
        return out


class PreNorm(nn.Module):
    """A layer behind its norm."""

    def __init__(self, width: int, fn: nn.Module) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.fn = fn

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        """(..., N, D) -> (..., N, D)."""
        out: torch.Tensor = self.fn(self.norm(tokens))
        return out


class Transformer(nn.Module):
    """Pre-norm layers of self-attention and feed-forward, each added to what came in."""

    def __init__(self, preset: Preset) -> None:
        super().__init__()
        width = preset.token_width
        self.layers = nn.ModuleList(
            nn.ModuleList(
                [
                    PreNorm(width, Attention(width, preset.heads, preset.head_width)),
                    PreNorm(width, FeedForward(width, preset.feedforward_width)),
                ]
            )
            for _ in range(preset.layers)
        )

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        """(..., N, D) -> (..., N, D)."""
        for layer in self.layers:
            assert isinstance(layer, nn.ModuleList)
            for step in layer:
                tokens = tokens + step(tokens)
        return tokens


class LayoutPool(nn.Module):
    """A map as one vector that still says what is where: few channels, then a linear layer over places."""

    def __init__(self, channels: int, side: int, kept: int, width: int) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(channels, kept, 1)
        self.embed = nn.Linear(kept * side * side, width)

    def forward(self, feature_map: torch.Tensor) -> torch.Tensor:
        """(B, C, h, w) -> (B, width)."""
        out: torch.Tensor = self.embed(functional.relu(self.reduce(feature_map)).flatten(1))
        return out


class Refinement(nn.Module):
    """Two 3x3 convolutions, added to what came in. (B, width, h, w) to the same."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn1 = group_norm(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = group_norm(width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Add what the neighbourhood says."""
        hidden = functional.relu(self.bn1(self.conv1(x)))
        return functional.relu(x + self.bn2(self.conv2(hidden)))


class Descriptors(nn.Module):
    """Unit-length local features at one stage's resolution, with the last stage's view of the whole."""

    def __init__(self, settings: CorrelationSettings, widths: Iterable[int]) -> None:
        super().__init__()
        widths = list(widths)
        width = settings.descriptor_width
        self.stage = settings.stage
        self.local = nn.Conv2d(widths[settings.stage], width, 1)
        self.wide = nn.ModuleList(nn.Conv2d(channels, width, 1) for channels in widths[settings.stage + 1 :])
        self.refine = nn.Sequential(*(Refinement(width) for _ in range(settings.descriptor_depth)))
        self.mix = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, maps: Sequence[torch.Tensor | None]) -> torch.Tensor:
        """Maps of all stages, of which those from the descriptors' on are read -> (B, width, h, w)."""
        local: torch.Tensor = self.local(maps[self.stage])
        for feature_map, convolution in zip(maps[self.stage + 1 :], self.wide, strict=True):
            assert feature_map is not None
            local = local + functional.interpolate(
                convolution(feature_map), size=local.shape[-2:], mode="bilinear", align_corners=False
            )
        return functional.normalize(self.mix(self.refine(functional.relu(local))), dim=1)


class Encoder(nn.Module):
    """Backbone, index encoding and cross-view transformer."""

    def __init__(self, preset: Preset) -> None:
        super().__init__()
        lite = preset.backbone == "efficientnet_lite0"
        self.feature_extractor = EfficientNetLite0() if lite else Backbone(preset)
        widths = self.feature_extractor.widths
        self.feature_positional_encoding = (
            IndexEncoding(preset.max_views, preset.token_width) if preset.index_encoding else None
        )
        self.transformer = nn.Sequential(Transformer(preset), nn.LayerNorm(preset.token_width))
        self.layout = None
        first = len(widths) - 1 if preset.correlation is None else preset.correlation.stage
        sides = [preset.image_size // 2 ** (stage + 2) for stage in range(len(widths))]
        self.summarised_shapes = {
            stage: (widths[stage], sides[stage], sides[stage]) for stage in range(first, len(widths))
        }
        """(C, h, w) of the maps of those stages that `summarise` reads."""
        if preset.layout_width is not None:
            self.layout = LayoutPool(widths[-1], sides[-1], preset.layout_width, preset.pooled_width)
        self.descriptors = None if preset.correlation is None else Descriptors(preset.correlation, widths)

    def look(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """What views say on their own: (B, 3, S, S) -> (B, F) pooled, and descriptors (B, C, h, w) if any."""
        return self.summarise(self.feature_extractor.stage_maps(images))

    def summarise(self, maps: Sequence[torch.Tensor | None]) -> tuple[torch.Tensor, torch.Tensor | None]:
        """`look` from the maps of the backbone's stages on.

        Those before the descriptors' are not read; where the last ones are missing, the backbone goes on from
        the last one given.
        """
        last = maps[-1]
        assert last is not None
        later = self.feature_extractor.later_maps(last, len(maps) - 1)
        maps, last = [*maps, *later], (later or [last])[-1]
        pooled = last.mean((-2, -1)) if self.layout is None else self.layout(last)
        return pooled, None if self.descriptors is None else self.descriptors(maps)

    def relate(self, tokens: torch.Tensor) -> torch.Tensor:
        """What each view says having heard the others: (..., N, D) -> (..., N, D)."""
        if self.feature_positional_encoding is not None:
            tokens = self.feature_positional_encoding(tokens)
        out: torch.Tensor = self.transformer(tokens)
        return out
