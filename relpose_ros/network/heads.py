"""What is read from tokens and maps: a pair's correlation, and numbers that a view regresses."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import nn

from relpose_ros.network.backbone import group_norm

if TYPE_CHECKING:
    from relpose_ros.network.presets import CorrelationSettings


class Regressor(nn.Module):
    """Numbers from a view's token and the first view's: a perceptron with one residual step.

    Its attribute names are those of the released translation head.
    """

    def __init__(self, token_width: int, widths: tuple[int, int], outputs: int) -> None:
        super().__init__()
        wide, narrow = widths
        self.embed_feature = nn.Linear(2 * token_width, wide)
        self.block1 = nn.Sequential(
            nn.LeakyReLU(), nn.Linear(wide, wide), nn.LeakyReLU(), nn.Linear(wide, narrow)
        )
        self.block2 = nn.Sequential(
            nn.LeakyReLU(), nn.Linear(narrow, narrow), nn.LeakyReLU(), nn.Linear(narrow, narrow)
        )
        self.decode = nn.Sequential(nn.LeakyReLU(), nn.Linear(narrow, outputs))

    def forward(self, tokens: torch.Tensor, first: torch.Tensor) -> torch.Tensor:
        """(..., D) and (..., D) of the first view -> (..., outputs)."""
        hidden = self.block1(self.embed_feature(torch.cat([tokens, first], -1)))
        out: torch.Tensor = self.decode(hidden + self.block2(hidden))
        return out


class CorrelationReader(nn.Module):
    """What matches where between two views' descriptors, as one vector (see `CorrelationSettings`).

    It depends on the order of the views, as the rotation does.
    """

    def __init__(self, settings: CorrelationSettings, width: int) -> None:
        super().__init__()
        self.side = settings.map_side
        values, layout = settings.match_width, settings.layout_widths
        quarter = (self.side // 4) ** 2
        self.log_sharpness = nn.Parameter(torch.tensor(math.log(20.0)))
        self.matched_at = nn.Parameter(_cosine_basis(self.side, values))
        self.claimed_by = nn.Parameter(_cosine_basis(self.side, values))
        self.read_layout = nn.Sequential(
            nn.Conv2d(2 * values + 1, layout[0], 1),
            group_norm(layout[0]),
            nn.LeakyReLU(),
            nn.Conv2d(layout[0], layout[0], 3, stride=2, padding=1),
            group_norm(layout[0]),
            nn.LeakyReLU(),
            nn.Conv2d(layout[0], layout[1], 3, stride=2, padding=1),
            group_norm(layout[1]),
            nn.LeakyReLU(),
            nn.Flatten(),
            nn.Linear(layout[1] * quarter, settings.summary_width),
            # Without a norm training lets summaries grow until the rotation beside them is lost in rounding.
            nn.LayerNorm(settings.summary_width),
            nn.LeakyReLU(),
            nn.Linear(settings.summary_width, width),
        )

    @property
    def sharpness(self) -> torch.Tensor:
        """By which cosines are multiplied before a softmax: at most 40, below which no row can vanish."""
        return self.log_sharpness.exp().clamp(max=40)

    def forward(self, maps_i: torch.Tensor, maps_j: torch.Tensor) -> torch.Tensor:
        """Unit descriptors of views i and of views j, (P, C, h, w) each -> (P, width)."""
        # In full precision: in half of it the sums of a softmax overflow or vanish.
        with torch.autocast(maps_i.device.type, enabled=False):
            places = self._matched(maps_i.to(self.matched_at.dtype), maps_j.to(self.matched_at.dtype))
        layout = places.reshape(-1, self.side, self.side, places.shape[-1]).movedim(-1, 1)
        out: torch.Tensor = self.read_layout(layout)
        return out

    def _matched(self, maps_i: torch.Tensor, maps_j: torch.Tensor) -> torch.Tensor:
        """Where each place of i is found in j, and which places of i claim that of j: (P, places, values)."""
        sharpness = self.sharpness
        descriptors_i, descriptors_j = (maps.flatten(2) * sharpness.sqrt() for maps in (maps_i, maps_j))
        # One exponential, of a cosine less 1, serves both softmaxes. All else is done by products of
        # matrices: these maps are what a training step waits for.
        likeness = torch.baddbmm(-sharpness[None, None, None], descriptors_i.mT, descriptors_j).exp()
        one = torch.ones_like(self.matched_at[:, :1])
        # Softmax over j's places: where a place of i is found. Softmax over i's: which places of j claim it.
        found = likeness @ torch.cat([self.matched_at, one], -1)
        found = found[..., :-1] / found[..., -1:]
        claims = 1 / likeness.sum(-2)[..., None]  # (P, places of j, 1)
        claimed = likeness @ torch.cat([self.claimed_by * claims, claims], -1)
        return torch.cat([found, claimed], -1)


def _cosine_basis(side: int, count: int) -> torch.Tensor:
    """The ``count`` smoothest non-constant cosine functions on a map of side x side places: (places, count).

    Read through them, a match says where it is from the first step of training on.
    """
    waves = np.cos(np.pi / side * (np.arange(side) + 0.5)[:, None] * np.arange(side))
    order = sorted((u + v, u, v) for u in range(side) for v in range(side))[1 : count + 1]
    basis = np.stack([(waves[:, u, None] * waves[:, v]).reshape(-1) for _, u, v in order], -1)
    return torch.from_numpy(basis).float()
