"""What the network knows of views: one by one, and having heard each other. Data only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from typing_extensions import Self

    Index = int | slice | Sequence[int] | torch.Tensor


@dataclass(frozen=True, eq=False)
class _Views:
    """A vector and perhaps a map for each view; an index picks along the dimension of views."""

    vectors: torch.Tensor
    maps: torch.Tensor | None

    def __len__(self) -> int:
        return self.vectors.shape[-2]

    def __getitem__(self, index: Index) -> Self:
        maps = None if self.maps is None else self.maps[..., index, :, :, :]
        return type(self)(self.vectors[..., index, :], maps)

    @classmethod
    def stack(cls, views: Sequence[Self]) -> Self:
        """Single views as one set, in order."""
        maps = [view.maps for view in views if view.maps is not None]
        vectors = torch.stack([view.vectors for view in views], -2)
        return cls(vectors, torch.stack(maps, -4) if maps else None)


@dataclass(frozen=True, eq=False)
class ViewFeatures(_Views):
    """What each view says on its own: computed once and kept while the view is in the scan."""

    @property
    def pooled(self) -> torch.Tensor:
        """(..., N, F); (..., F) for a single view."""
        return self.vectors


@dataclass(frozen=True, eq=False)
class SceneFeatures(_Views):
    """What each view says having heard the others, beside its own local descriptors.

    Where a preset limits the context to two views, tokens are still those of single views, and the
    transformer runs over each pair when the pair is asked for.
    """

    @property
    def tokens(self) -> torch.Tensor:
        """(..., N, D); (..., D) for a single view."""
        return self.vectors
