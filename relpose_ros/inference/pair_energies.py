"""The energies of all pairs of one scan: what two views say together once, then any rotation.

`EnergyModel` is all that the solver needs to know of a network. Rotations are optical column-vector
``camera_j_from_camera_i`` throughout; the network converts them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import torch

from relpose_ros.geometry import so3_grid

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from relpose_ros.inference.rotation_evidence import RotationEvidence

COARSE_LEVEL = 1
"""Cells of 30 degrees."""
LAST_KEPT_LEVEL = 2
"""Whole levels are kept up to this one: 5 MB at the published size. The next would be 38 MB, of which a scan
looks at a few per cent."""
NORMALISED = (32, 8)
"""Cells of the coarse level, and of the one below, that are split to normalise a distribution."""
ROWS = 2048
"""Rotations scored in one go: enough for two cores to share, and at 256 floats a row 2 MB, which caches hold
between layers."""


class ScoresRotations(Protocol):
    """The part of a network that scores relative rotations; see `relpose_ros.network.energy_head`."""

    def embed(self, rotations: torch.Tensor) -> torch.Tensor:
        """What rotations contribute before a pair is known. (..., 3, 3) -> (..., H)."""
        ...

    def energies(self, contexts: torch.Tensor, embeddings: torch.Tensor) -> torch.Tensor:
        """Unnormalised log-likelihoods. (P, H) with (K, H) or (P, K, H) -> (P, K)."""
        ...

    def energies_and_gradients(
        self, contexts: torch.Tensor, rotations: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The same, and derivatives by the entries. (P, H), (P, K, 3, 3) -> (P, K), (P, K, 3, 3)."""
        ...


class EnergyModel(Protocol):
    """All of a network that the solver knows of."""

    def pair_contexts(self, features: Any, i: torch.Tensor, j: torch.Tensor) -> torch.Tensor:
        """What a pair contributes before a rotation is known. (P,), (P,) view positions -> (P, H)."""
        ...

    def energy_head(self) -> ScoresRotations:
        """What scores rotations, given those."""
        ...


class GridEmbeddings:
    """Embeddings of the rotation grid's cells: the same for every pair of every scan of one network.

    Kept for the life of the object, so it belongs to one set of weights.
    """

    def __init__(self, model: EnergyModel) -> None:
        self._model = model
        self._levels: dict[int, torch.Tensor] = {}

    @cached_property
    def _head(self) -> ScoresRotations:
        """Made when it is first asked for: a network that regresses rotations has none."""
        return self._model.energy_head()

    def of_cells(self, level: int, cells: torch.Tensor) -> torch.Tensor:
        """Embeddings of some cells of a level. (..., C) int64 -> (..., C, H)."""
        if level <= LAST_KEPT_LEVEL:
            return self(level)[cells]
        return self._head.embed(so3_grid.centres(level, cells))

    def __call__(self, level: int) -> torch.Tensor:
        """(72 * 8^level, H) embeddings of a whole level."""
        if level not in self._levels:
            rotations = torch.tensor(so3_grid.grid(level))
            parts = [self._head.embed(part) for part in torch.split(rotations, ROWS)]
            self._levels[level] = torch.cat(parts)
        return self._levels[level]


@dataclass(frozen=True, eq=False)
class PairEnergies:
    """All unordered pairs of N views, each scored once with i < j."""

    head: ScoresRotations
    contexts: torch.Tensor
    """(P, H) with P = N (N - 1) / 2, ordered by i, then j."""
    i: torch.Tensor
    """(P,) int64."""
    j: torch.Tensor
    """(P,) int64."""
    views: int
    """N."""
    temperature: float = 1.0
    """The network's energies are divided by it; infinity silences the network."""
    evidence: RotationEvidence | None = None
    """Added to the network's energies where there is some."""
    log_share: torch.Tensor | None = None
    """(P,) what makes them a mixture, see `mixed`; None: they are taken as they are."""
    flat: float = 0.0
    """Share of the uniform distribution in that mixture."""
    weight: float = 1.0
    """Of the network's part in the sum with the evidence."""
    coarse: torch.Tensor | None = None
    """(P, 72 * 8^COARSE_LEVEL) the network's own energies of that level, where they are known."""

    @classmethod
    def of(
        cls,
        model: EnergyModel,
        features: Any,
        views: int,
        temperature: float = 1.0,
        evidence: RotationEvidence | None = None,
    ) -> PairEnergies:
        """Computes the contexts of all pairs of a scan."""
        i, j = torch.triu_indices(views, views, 1).unbind(0)
        contexts = model.pair_contexts(features, i, j)
        return cls(model.energy_head(), contexts, i, j, views, temperature, evidence)

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
                energies[pair, part] = self.head.energies(self.contexts[pair : pair + 1], embeddings[part])[0]
        return energies

    def mixed(self, grid: GridEmbeddings, flat: float) -> PairEnergies:
        """Log-densities relative to uniform of a mixture: the network's distribution and the uniform one.

        A network that is plainly wrong about some pairs must not rule anything out by itself.

        Args:
            grid: the embeddings of the rotation grid.
            flat: share of the uniform distribution, 0 < flat < 1.
        """
        coarse = self.on_grid(grid(COARSE_LEVEL))
        level, values = COARSE_LEVEL, coarse
        cells = torch.arange(values.shape[1]).expand(self.count, -1)
        parts = []
        for width in NORMALISED:
            values, order = torch.sort(values, dim=1, descending=True, stable=True)
            parts.append(values[:, width:] / self.temperature - math.log(so3_grid.size(level)))
            cells = torch.gather(cells, 1, order[:, :width])
            cells, level = torch.from_numpy(so3_grid.children(cells.numpy())), level + 1
            values = self._learned_on_cells(grid, level, cells)
        parts.append(values / self.temperature - math.log(so3_grid.size(level)))
        log_normalisers = torch.logsumexp(torch.cat(parts, 1), 1)
        return replace(self, log_share=math.log1p(-flat) - log_normalisers, flat=flat, coarse=coarse)

    def on_level(self, grid: GridEmbeddings, level: int) -> torch.Tensor:
        """Energies of every pair on a whole level. -> (P, 72 * 8^level)."""
        known = self.coarse if level == COARSE_LEVEL else None
        learned = self.on_grid(grid(level)) if known is None else known
        return self._at_cells(level, learned, torch.arange(so3_grid.size(level)))

    def on_cells(self, grid: GridEmbeddings, level: int, cells: torch.Tensor) -> torch.Tensor:
        """Energies of every pair at its own cells of a level. (P, C) int64 -> (P, C)."""
        return self._at_cells(level, self._learned_on_cells(grid, level, cells), cells)

    def at_centres(self, level: int, cells: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """What `on_cells` gave, without the blur of the evidence. (P, C) twice -> (P, C).

        The blur shows from afar where a sharp peak is. What it lends to cells beside the peak is counted in
        the peak's own cells already.
        """
        if self.evidence is None:
            return values
        pairs = torch.arange(self.count)
        rotations = so3_grid.centres(level, cells)
        blurred = self.evidence(pairs, rotations, so3_grid.cell_spacing(level) / 2)
        return values + (self.evidence(pairs, rotations) - blurred).to(values.dtype)

    def at(self, pairs: torch.Tensor, rotations: torch.Tensor) -> torch.Tensor:
        """Energies at any rotations. (Q,) int64 pairs, (Q, K, 3, 3) -> (Q, K)."""
        parts = [
            self.head.energies(self.contexts[pairs[part]], self.head.embed(rotations[part]))
            for part in _blocks(*rotations.shape[:2])
        ]
        learned = self._calibrated(_joined(parts), pairs)
        if self.evidence is None:
            return learned
        return learned + self.evidence(pairs, rotations)

    def uphill(self, pairs: torch.Tensor, rotations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Energies, and their gradients for left perturbations ``exp(w) R``.

        Args:
            pairs: (Q,) int64.
            rotations: (Q, K, 3, 3) float64.

        Returns:
            (Q, K) and (Q, K, 3), float64.
        """
        parts = [
            self.head.energies_and_gradients(self.contexts[pairs[part]], rotations[part])
            for part in _blocks(*rotations.shape[:2])
        ]
        energies, gradients = (_joined(each) for each in zip(*parts, strict=True))
        values = self._calibrated(energies, pairs).double()
        gradients = gradients.double() * self._calibrated_slopes(energies, pairs)[..., None, None]
        if self.evidence is not None:
            more, more_gradients = self.evidence.with_gradients(pairs, rotations)
            values, gradients = values + more, gradients + more_gradients
        # d tr(G^T exp(w) R) / dw at zero is the axis of the skew part of G R^T.
        turns = gradients @ rotations.mT
        skew = turns - turns.mT
        return values, torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)

    def _at_cells(self, level: int, learned: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
        """From the network's energies of a level's cells to those of all evidence."""
        calibrated = self._calibrated(learned, slice(None))
        if self.evidence is None:
            return calibrated
        rotations, blur = so3_grid.centres(level, cells), so3_grid.cell_spacing(level) / 2
        return calibrated + self.evidence(torch.arange(self.count), rotations, blur).to(calibrated.dtype)

    def _learned_on_cells(self, grid: GridEmbeddings, level: int, cells: torch.Tensor) -> torch.Tensor:
        """What the network itself gives at every pair's own cells. (P, C) int64 -> (P, C)."""
        parts = [
            self.head.energies(self.contexts[part], grid.of_cells(level, cells[part]))
            for part in _blocks(*cells.shape)
        ]
        return torch.cat(parts)

    def _calibrated(self, energies: torch.Tensor, pairs: torch.Tensor | slice) -> torch.Tensor:
        """From the network's energies (Q, K) of some pairs to log-likelihoods."""
        energies = energies / self.temperature
        if self.log_share is not None:
            uniform = torch.tensor(math.log(self.flat), dtype=energies.dtype)
            energies = torch.logaddexp(energies + self.log_share[pairs, None], uniform)
        return energies * self.weight

    def _calibrated_slopes(self, energies: torch.Tensor, pairs: torch.Tensor) -> torch.Tensor:
        """Derivatives of `_calibrated` by the network's energies. (Q, K) -> (Q, K) float64."""
        slopes = torch.full_like(energies, self.weight / self.temperature, dtype=torch.float64)
        if self.log_share is None:
            return slopes
        log_odds = energies / self.temperature + self.log_share[pairs, None] - math.log(self.flat)
        return slopes * torch.sigmoid(log_odds)


def _joined(parts: Sequence[torch.Tensor]) -> torch.Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


def _blocks(rows: int, columns: int) -> Iterator[slice]:
    step = max(1, ROWS // columns)
    for start in range(0, rows, step):
        yield slice(start, min(rows, start + step))
