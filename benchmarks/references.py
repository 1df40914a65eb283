"""Two slow ways from pair energies to rotations, to hold the fast one against.

`exhaustive` evaluates every pair and every camera on a dense grid and then densely around what it found: no
pruning, nothing clever, nothing random. `published` is the procedure of RelPose++ (Lin et al., 3DV 2024),
rebuilt from its description: random proposals, each ordered pair scored on its own, embeddings recomputed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from relpose_ros.geometry import so3, so3_grid
from relpose_ros.inference.global_rotations import joint_scores, spanning_order
from relpose_ros.inference.pair_energies import ROWS

if TYPE_CHECKING:
    from relpose_ros.inference.pair_energies import PairEnergies

PAIR_PROPOSALS = 500_000
ASCENT_PROPOSALS = 250_000
ASCENT_ROUNDS = 50


def local_lattice(radius: float, steps: int) -> torch.Tensor:
    """Rotations on a cubic lattice of tangent offsets, (2 steps + 1)^3 of them, centre included."""
    axis = torch.linspace(-radius, radius, 2 * steps + 1, dtype=torch.float64)
    return torch.from_numpy(so3.exp(torch.cartesian_prod(axis, axis, axis).numpy()))


def best_of_pair(energies: PairEnergies, pair: int, level: int) -> tuple[torch.Tensor, float]:
    """The best rotation of one pair: all cells of a level, then dense lattices around the best cell."""
    rotations = torch.from_numpy(np.array(so3_grid.grid(level)))
    best, value = _argmax(energies, pair, rotations)
    radius = so3_grid.cell_spacing(level)
    for _ in range(3):
        best, value = _argmax(energies, pair, local_lattice(radius, 4) @ best)
        radius /= 4
    return best, value


def exhaustive(energies: PairEnergies, level: int = 3) -> tuple[torch.Tensor, float]:
    """Best rotation of each pair, maximum spanning tree, dense block coordinate ascent to the end.

    Returns:
        (N, 3, 3) camera_from_object and the joint score.
    """
    found = [best_of_pair(energies, pair, level) for pair in range(energies.count)]
    everywhere = torch.from_numpy(np.array(so3_grid.grid(level)))
    heights = energies.on_grid(energies.head.embed(everywhere)).double()
    strengths = torch.tensor([value for _, value in found], dtype=torch.float64) - heights.logsumexp(1)
    rotations = _along_tree(energies, [rotation for rotation, _ in found], strengths)
    spacing = so3_grid.cell_spacing(level)
    score = float(joint_scores(energies, rotations[None])[0])
    for radius in (None, spacing, spacing / 4, spacing / 16):
        for _ in range(20):
            for camera in range(energies.views):
                candidates = everywhere if radius is None else local_lattice(radius, 4) @ rotations[camera]
                candidates = torch.cat([rotations[camera : camera + 1], candidates])
                totals = conditional(energies, rotations, camera, candidates)
                rotations[camera] = candidates[int(totals.argmax())]
            before, score = score, float(joint_scores(energies, rotations[None])[0])
            if score <= before + 1e-3:
                break
    return rotations @ rotations[0].T, score


def published(
    energies: PairEnergies, generator: np.random.Generator, scale: float = 1.0
) -> tuple[torch.Tensor, float, int]:
    """RelPose++'s own procedure.

    Args:
        energies: of the scan.
        generator: draws the proposals.
        scale: share of the published numbers of proposals; 1 is what the authors run.

    Returns:
        (N, 3, 3) camera_from_object, the joint score, and how many energies were evaluated.
    """
    evaluated = 0
    best: list[torch.Tensor] = []
    strengths = []
    for pair in range(energies.count):
        # The released code scores (i, j) and (j, i), and keeps one of the two.
        for _ in range(2):
            proposals = torch.from_numpy(so3.random_rotations(int(scale * PAIR_PROPOSALS), generator))
            values = _energies(energies, pair, proposals)
            evaluated += len(values)
        best.append(proposals[int(values.argmax())])
        strengths.append(float(values.max() - values.double().logsumexp(0)))
    rotations = _along_tree(energies, best, torch.tensor(strengths, dtype=torch.float64))
    for _ in range(ASCENT_ROUNDS):
        camera = int(generator.integers(energies.views))
        proposals = torch.from_numpy(so3.random_rotations(int(scale * ASCENT_PROPOSALS), generator))
        proposals = torch.cat([rotations[camera : camera + 1], proposals])
        totals = conditional(energies, rotations, camera, proposals)
        evaluated += len(proposals) * (energies.views - 1)
        rotations[camera] = proposals[int(totals.argmax())]
    score = float(joint_scores(energies, rotations[None])[0])
    return rotations @ rotations[0].T, score, evaluated


def published_evaluations(views: int) -> int:
    """How many energies the published procedure evaluates for N views."""
    return views * (views - 1) * PAIR_PROPOSALS + ASCENT_ROUNDS * (views - 1) * (ASCENT_PROPOSALS + 1)


def conditional(
    energies: PairEnergies, rotations: torch.Tensor, camera: int, candidates: torch.Tensor
) -> torch.Tensor:
    """Summed energy of one camera's pairs at each candidate, the others held. (K, 3, 3) -> (K,)."""
    totals = torch.zeros(len(candidates), dtype=torch.float64)
    for other in range(energies.views):
        if other == camera:
            continue
        camera_from_other = candidates @ rotations[other].T
        relative = camera_from_other if camera > other else camera_from_other.mT
        totals += _energies(energies, int(energies.pair_of[camera, other]), relative).double()
    return totals


def _energies(energies: PairEnergies, pair: int, rotations: torch.Tensor) -> torch.Tensor:
    which = torch.tensor([pair])
    return torch.cat([energies.at(which, part[None])[0] for part in torch.split(rotations, ROWS)])


def _argmax(energies: PairEnergies, pair: int, rotations: torch.Tensor) -> tuple[torch.Tensor, float]:
    values = _energies(energies, pair, rotations)
    best = int(values.argmax())
    return rotations[best], float(values[best])


def _along_tree(
    energies: PairEnergies, relative: list[torch.Tensor], strengths: torch.Tensor
) -> torch.Tensor:
    """Rotations along a maximum spanning tree from the first camera. -> (N, 3, 3)."""
    order = spanning_order(strengths, energies.pair_of)
    rotations = torch.eye(3, dtype=torch.float64).repeat(energies.views, 1, 1)
    for position in range(1, len(order)):
        camera, placed = order[position], order[:position]
        pairs = energies.pair_of[camera, placed]
        parent = placed[int(strengths[pairs].argmax())]
        pair = int(energies.pair_of[camera, parent])
        camera_from_parent = relative[pair] if camera > parent else relative[pair].T
        rotations[camera] = camera_from_parent @ rotations[parent]
    return rotations
