"""The distribution of every pair's relative rotation, found coarse to fine on the nested rotation grid.

The energies of a pair are evaluated on all cells of a coarse level; the best cells are split into their
eight children, and so on down. What remains is a partition of SO(3), fine where the pair is likely and
coarse where it is not: a quadrature of the normalised distribution, and the place to look for its modes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from relpose_ros.geometry import so3, so3_grid

if TYPE_CHECKING:
    from collections.abc import Callable

    from relpose_ros.inference.pair_energies import GridEmbeddings, PairEnergies

_EYE = torch.eye(3, dtype=torch.float64)
_HAT = torch.from_numpy(so3.hat(np.eye(3)).reshape(3, 9))
"""From a vector, a row, to the rows of its skew matrix."""


@dataclass(frozen=True)
class SearchSettings:
    """How the grid is searched: ``benchmarks/solver.py --search-table`` prints what each choice finds."""

    level: int = 1
    """The level evaluated in full: 72 * 8^level cells a pair, 30 degrees apart at level 1."""
    widths: tuple[int, ...] = (64, 24, 8, 8)
    """Cells split at that level and at each one below it: cells of 2 degrees at the end."""
    full_scan: int = 28
    """The widths are meant for so many pairs. Fewer pairs are searched as much wider, up to `widest` times:
    two views then cost what eight do, and are searched nearly densely."""
    widest: int = 8
    modes: int = 12
    """Modes looked for a pair."""
    separation: float = math.radians(25)
    """Modes nearer than this are one, rad: the cells of the coarse level are about that far apart."""
    refinement_steps: int = 8
    """Gradient steps a mode, the first of half a cell."""


@dataclass(frozen=True, eq=False)
class PairDistributions:
    """Distributions of P pairs, each on its own partition of SO(3) into L cells. Tensors are float64."""

    rotations: torch.Tensor
    """(P, L, 3, 3) cell centres, camera_j_from_camera_i."""
    energies: torch.Tensor
    """(P, L) as `PairEnergies` gives them, the evidence blurred in the finest cells alone."""
    log_volumes: torch.Tensor
    """(L,) log of the share of SO(3) that a cell fills; the same for every pair."""
    spacings: torch.Tensor
    """(L,) edge of a cell, rad."""
    coarse: torch.Tensor
    """(P, C) highest energy met in each cell of ``coarse_level``, the evidence blurred."""
    coarse_level: int
    modes: torch.Tensor
    """(P, M, 3, 3) local maxima, highest energy first."""
    mode_energies: torch.Tensor
    """(P, M); -inf where a pair has fewer modes."""

    def log_normaliser(self, temperature: float = 1.0) -> torch.Tensor:
        """Log of the mean of exp(energy / temperature) over SO(3). -> (P,)."""
        return torch.logsumexp(self.energies / temperature + self.log_volumes, -1)

    def masses(self, temperature: float = 1.0, flat: float = 0.0) -> torch.Tensor:
        """Probability of each cell, a share ``flat`` of it uniform; every row sums to one. -> (P, L)."""
        asked = temperature, flat
        if asked not in self._masses:
            masses = torch.softmax(self.energies / temperature + self.log_volumes, -1)
            self._masses[asked] = masses if flat == 0 else (1 - flat) * masses + flat * self.log_volumes.exp()
        return self._masses[asked]

    @cached_property
    def _masses(self) -> dict[tuple[float, float], torch.Tensor]:
        """Those worked out so far: the pairs and the cameras are told from the same ones."""
        return {}

    @cached_property
    def mode_log_densities(self) -> torch.Tensor:
        """Log density of each mode relative to uniform: comparable between pairs. -> (P, M)."""
        return self.mode_energies - self.log_normaliser()[:, None]


def search(
    energies: PairEnergies, grid: GridEmbeddings, settings: SearchSettings = SearchSettings()
) -> PairDistributions:
    """Evaluates every pair coarse to fine and refines its modes."""
    level = settings.level
    cells = torch.arange(so3_grid.size(level)).expand(energies.count, -1)
    values = energies.on_level(grid, level)
    coarse = values.double()
    ancestors = cells
    kept: list[tuple[int, torch.Tensor, torch.Tensor]] = []
    wider = min(settings.widest, max(1.0, settings.full_scan / energies.count))
    for width in (min(round(wider * width), so3_grid.size(settings.level)) for width in settings.widths):
        values, order = torch.sort(values, dim=1, descending=True, stable=True)
        cells, ancestors = torch.gather(cells, 1, order), torch.gather(ancestors, 1, order)
        kept.append((level, cells[:, width:], values[:, width:]))
        cells = torch.from_numpy(so3_grid.children(cells[:, :width].numpy()))
        ancestors = ancestors[:, :width].repeat_interleave(8, 1)
        level += 1
        values = energies.on_cells(grid, level, cells)
        coarse = coarse.scatter_reduce(1, ancestors, values.double(), "amax")
    kept.append((level, cells, values))

    rotations = torch.cat([so3_grid.centres(at, index) for at, index, _ in kept], 1)
    blurred = torch.cat([value for _, _, value in kept], 1).double()
    left = [energies.at_centres(at, index, value) for at, index, value in kept[:-1]]
    scores = torch.cat([*left, values], 1).double()
    volumes = [-math.log(so3_grid.size(at)) for at, _, _ in kept]
    edges = [so3_grid.cell_spacing(at) for at, _, _ in kept]
    counts = torch.tensor([index.shape[1] for _, index, _ in kept])
    log_volumes = torch.tensor(volumes, dtype=torch.float64).repeat_interleave(counts)
    spacings = torch.tensor(edges, dtype=torch.float64).repeat_interleave(counts)
    tops, heights = highest_apart(rotations, blurred, settings.modes, settings.separation)
    modes, mode_energies = _refine_modes(
        energies, pick(rotations, tops), heights, spacings[tops] / 2, settings
    )
    return PairDistributions(
        rotations, scores, log_volumes, spacings, coarse, settings.level, modes, mode_energies
    )


def pick(rotations: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
    """In each row the rotations at some positions. (P, L, 3, 3), (P, M) int64 -> (P, M, 3, 3)."""
    return torch.gather(rotations, 1, positions[..., None, None].expand(-1, -1, 3, 3))


def highest_apart(
    rotations: torch.Tensor, values: torch.Tensor, count: int, separation: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The highest of some rotations, in each row, of which no two are nearer than ``separation``.

    Args:
        rotations: (P, L, 3, 3); or (P, L, N, 3, 3), of which two are as near as their most distant rotations.
        values: (P, L).
        count: M, how many to pick in each row at most.
        separation: rad.

    Returns:
        Positions (P, <= M) int64, highest first, and values (P, <= M), -inf where a row has no more.
    """
    least_trace = 1 + 2 * math.cos(separation)
    flat = rotations.reshape(*values.shape, -1, 9)  # the trace of A B^T is their scalar product
    left = values.clone()
    rows = torch.arange(len(flat))
    tops, heights = [], []
    for _ in range(min(count, values.shape[1])):
        best = left.argmax(1)
        tops.append(best)
        heights.append(left[rows, best])
        traces = torch.einsum("plna,pna->pln", flat, flat[rows, best]).amin(2)
        left = left.masked_fill(traces > least_trace, -math.inf)
        left[rows, best] = -math.inf
    return torch.stack(tops, 1), torch.stack(heights, 1)


def _refine_modes(
    energies: PairEnergies,
    modes: torch.Tensor,
    values: torch.Tensor,
    strides: torch.Tensor,
    settings: SearchSettings,
) -> tuple[torch.Tensor, torch.Tensor]:
    pairs = torch.arange(energies.count)
    refined, best = ascend(
        lambda rotations: energies.uphill(pairs, rotations), modes, strides, settings.refinement_steps
    )
    best = best.masked_fill(values == -math.inf, -math.inf)
    best, order = torch.sort(best, dim=1, descending=True, stable=True)
    refined = pick(refined, order)
    # Two starts may have climbed the same hill: the lower one is no mode of its own.
    traces = torch.einsum("pmab,pnab->pmn", refined, refined)
    same = torch.tril(traces > 1 + 2 * math.cos(settings.separation), diagonal=-1).any(-1)
    best = best.masked_fill(same, -math.inf)
    best, order = torch.sort(best, dim=1, descending=True, stable=True)
    return pick(refined, order), best


def ascend(
    uphill: Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]],
    rotations: torch.Tensor,
    strides: torch.Tensor,
    steps: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Climbs many rotations at once, each along its own gradient on the tangent space.

    The stride grows while the height does and shrinks where it would not: energies have ripples of any
    steepness, so that the gradient's direction is trusted and its length is not.

    Args:
        uphill: the height of each rotation, and its gradient for left perturbations ``exp(w) R``:
            (..., 3, 3) -> (...), (..., 3), float64.
        rotations: (..., 3, 3) float64 starts.
        strides: (...) first steps, rad.
        steps: how many.

    Returns:
        Rotations (..., 3, 3) and heights (...), none lower than at the start.
    """
    here = rotations
    value, slope = uphill(here)
    length = strides
    for _ in range(steps):
        direction = slope / slope.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        there = turned(here, direction * length[..., None])
        new_value, new_slope = uphill(there)
        better = new_value > value
        here = torch.where(better[..., None, None], there, here)
        slope = torch.where(better[..., None], new_slope, slope)
        value = torch.where(better, new_value, value)
        length = torch.where(better, length * 1.2, length * 0.4)
    return here, value


def turned(rotations: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """``exp(w) R``. (..., 3, 3), (..., 3) -> (..., 3, 3).

    As `so3.exp`, in torch: a climb asks for a few at every step.
    """
    angle = vectors.norm(dim=-1)[..., None, None]
    skew = (vectors @ _HAT).view(*vectors.shape, 3)
    outer = vectors[..., :, None] * vectors[..., None, :]
    # Rodrigues; sinc(x) is sin(pi x) / (pi x), and exact at zero.
    halved = torch.sinc(angle / math.tau)
    turn: torch.Tensor = (
        angle.cos() * _EYE + torch.sinc(angle / math.pi) * skew + 0.5 * halved * halved * outer
    )
    return turn @ rotations


def turned_back(rotations: torch.Tensor, slopes: torch.Tensor) -> torch.Tensor:
    """From slopes for ``exp(w) R`` to those for ``R exp(-w)``. (..., 3, 3), (..., 3) -> (..., 3)."""
    return -(slopes[..., None, :] @ rotations)[..., 0, :]
