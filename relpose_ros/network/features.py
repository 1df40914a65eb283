"""What the network knows of views: one by one, and having heard each other. Data only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from collections.abc import Sequence

    Index = int | slice | Sequence[int] | torch.Tensor


@dataclass(frozen=True, eq=False)
class ViewFeatures:
    """What each view says on its own: computed once and kept while the view is in the scan.

    An index picks views.
    """

    pooled: torch.Tensor
    """(..., N, F); (..., F) for a single view."""
    maps: torch.Tensor | None
    """(..., N, C, h, w) unit local descriptors; None where the preset keeps none."""

    def __len__(self) -> int:
        return self.pooled.shape[-2]

    def __getitem__(self, index: Index) -> ViewFeatures:
        return ViewFeatures(self.pooled[..., index, :], _picked(self.maps, index))

    @classmethod
    def stack(cls, views: Sequence[ViewFeatures]) -> ViewFeatures:
        """Single views as one set, in order."""
        return cls(torch.stack([view.pooled for view in views], -2), _stacked([view.maps for view in views]))


@dataclass(frozen=True, eq=False)
class SceneFeatures:
    """What each view says having heard the others, beside its own local descriptors. An index picks views.

    Where a preset limits the context to two views, tokens are still those of single views, and the
    transformer runs over each pair when the pair is asked for.
    """

    tokens: torch.Tensor
    """(..., N, D); (..., D) for a single view."""
    maps: torch.Tensor | None
    """As in `ViewFeatures`."""

    def __len__(self) -> int:
        return self.tokens.shape[-2]

    def __getitem__(self, index: Index) -> SceneFeatures:
        return SceneFeatures(self.tokens[..., index, :], _picked(self.maps, index))

    @classmethod
    def stack(cls, views: Sequence[SceneFeatures]) -> SceneFeatures:
        """Single views as one set, in order."""
        return cls(torch.stack([view.tokens for view in views], -2), _stacked([view.maps for view in views]))


def _picked(maps: torch.Tensor | None, index: Index) -> torch.Tensor | None:
    return None if maps is None else maps[..., index, :, :, :]


def _stacked(maps: Sequence[torch.Tensor | None]) -> torch.Tensor | None:
    kept = [each for each in maps if each is not None]
    return torch.stack(kept, -4) if kept else None
