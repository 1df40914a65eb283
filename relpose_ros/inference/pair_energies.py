"""The energies of all pairs of one scan: what two views say together once, then any rotation.

`EnergyModel` is all that the solver needs to know of a network. Rotations are optical column-vector
``camera_j_from_camera_i`` throughout; the network converts them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch

from relpose_ros.geometry import so3_grid

if TYPE_CHECKING:
    from collections.abc import Iterator

LAST_KEPT_LEVEL = 2
"""Whole levels are kept up to this one: 5 MB at the published size. The next would be 38 MB, of which a scan
looks at a few per cent."""
ROWS = 1024
"""Rotations scored in one go: 1024 rows of 256 floats are 1 MB, and stay in a core's cache between layers."""


class EnergyModel(Protocol):
    """The part of a network that scores relative rotations."""

    def pair_contexts(self, features: Any, i: torch.Tensor, j: torch.Tensor) -> torch.Tensor:
        """What a pair contributes before a rotation is known. (P,), (P,) view positions -> (P, H)."""
        ...

    def embed_relative(self, camera_j_from_camera_i: torch.Tensor) -> torch.Tensor:
        """What a rotation contributes before a pair is known. (..., 3, 3) -> (..., H)."""
        ...

    def pair_energies(self, contexts: torch.Tensor, embeddings: torch.Tensor) -> torch.Tensor:
        """Unnormalised log-likelihoods. (P, H) with (K, H) or (P, K, H) -> (P, K)."""
        ...


class GridEmbeddings:
    """Embeddings of the rotation grid's cells: the same for every pair of every scan of one network.

    Kept for the life of the object, so it belongs to one set of weights.
    """

    def __init__(self, model: EnergyModel) -> None:
        self._model = model
        self._levels: dict[int, torch.Tensor] = {}

    def of_cells(self, level: int, cells: torch.Tensor) -> torch.Tensor:
        """Embeddings of some cells of a level. (..., C) int64 -> (..., C, H)."""
        if level <= LAST_KEPT_LEVEL:
            return self(level)[cells]
        rotations = torch.from_numpy(so3_grid.cell_rotations(level, cells.numpy()))
        return self._model.embed_relative(rotations.float())

    def __call__(self, level: int) -> torch.Tensor:
        """(72 * 8^level, H) embeddings of a whole level."""
        if level not in self._levels:
            rotations = torch.from_numpy(np.array(so3_grid.grid(level))).float()
            parts = [self._model.embed_relative(part) for part in torch.split(rotations, ROWS)]
            self._levels[level] = torch.cat(parts)
        return self._levels[level]


@dataclass(frozen=True, eq=False)
class PairEnergies:
    """All unordered pairs of N views, each scored once with i < j."""

    model: EnergyModel
    contexts: torch.Tensor
    """(P, H) with P = N (N - 1) / 2, ordered by i, then j."""
    i: torch.Tensor
    """(P,) int64."""
    j: torch.Tensor
    """(P,) int64."""
    views: int
    """N."""

    @classmethod
    def of(cls, model: EnergyModel, features: Any, views: int) -> PairEnergies:
        """Computes the contexts of all pairs of a scan."""
        i, j = torch.triu_indices(views, views, 1).unbind(0)
        return cls(model, model.pair_contexts(features, i, j), i, j, views)

    @property
    def count(self) -> int:
        """P, the number of pairs."""
        return len(self.i)

    @cached_property
    def pair_of(self) -> torch.Tensor:
        """(N, N) int64: position of a pair by its two views, in either order; -1 on the diagonal."""
        table = torch.full((self.views, self.views), -1, dtype=torch.int64)
        table[self.i, self.j] = table[self.j, self.i] = torch.arange(self.count)
        return table

    def on_grid(self, embeddings: torch.Tensor) -> torch.Tensor:
        """Energies of every pair at the same rotations. (K, H) -> (P, K)."""
        energies = torch.empty(self.count, len(embeddings), dtype=self.contexts.dtype)
        for pair in range(self.count):
            for start in range(0, len(embeddings), ROWS):
                part = slice(start, start + ROWS)
                energies[pair, part] = self.model.pair_energies(
                    self.contexts[pair : pair + 1], embeddings[part]
                )[0]
        return energies

    def on_cells(self, grid: GridEmbeddings, level: int, cells: torch.Tensor) -> torch.Tensor:
        """Energies of every pair at its own cells of a level. (P, C) int64 -> (P, C)."""
        parts = [
            self.model.pair_energies(self.contexts[part], grid.of_cells(level, cells[part]))
            for part in _blocks(*cells.shape)
        ]
        return torch.cat(parts)

    def at(self, pairs: torch.Tensor, rotations: torch.Tensor) -> torch.Tensor:
        """Energies at any rotations; differentiable. (Q,) int64 pairs, (Q, K, 3, 3) -> (Q, K)."""
        parts = [
            self.model.pair_energies(
                self.contexts[pairs[part]], self.model.embed_relative(rotations[part].to(self.contexts.dtype))
            )
            for part in _blocks(*rotations.shape[:2])
        ]
        return parts[0] if len(parts) == 1 else torch.cat(parts)


def _blocks(rows: int, columns: int) -> Iterator[slice]:
    step = max(1, ROWS // columns)
    for start in range(0, rows, step):
        yield slice(start, min(rows, start + step))
