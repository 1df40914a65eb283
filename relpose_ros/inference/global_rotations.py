"""One rotation per camera that all pairs agree with best: the joint maximum of the pairs' energies.

Cameras join in the order of a maximum spanning tree over the pairs' modes. Where RelPose++ keeps one
rotation per camera (the best mode along the tree), a beam of partial solutions is kept here, each camera
tried at every mode of every pair that ties it to those already placed. The best ends climb, all rotations
together along the gradient. Where pairs still contradict each other, beams grow from the other cameras too,
cameras jump to other modes, and the best climb by block coordinate ascent with a shrinking neighbourhood.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from relpose_ros.geometry import so3
from relpose_ros.inference.pair_distribution import ascend, peaks, pick

if TYPE_CHECKING:
    from relpose_ros.inference.pair_distribution import PairDistributions
    from relpose_ros.inference.pair_energies import PairEnergies


@dataclass(frozen=True)
class AscentSettings:
    """How the joint maximum is looked for. Numbers of solutions are for a full scan; see `many`."""

    full_scan: int = 28
    """Pairs that those numbers are meant for, 8 views."""
    most: int = 64
    beam: int = 20
    """Partial solutions kept while cameras join."""
    screened: int = 100
    """Ways to add a camera to the beam that are evaluated, the best by what the coarse grid remembers."""
    starts: int = 8
    """Complete solutions that climb."""
    climb_stride: float = math.radians(8)
    """First step of a climb, rad."""
    climb_steps: int = 16
    content: float = 1.5
    """Nats a pair. Where the pairs of a scan, or of a camera, are on average this near to their highest
    modes, no other place is looked for: the best could gain no more. Scans whose pairs agree become cheap."""
    jumpers: int = 3
    """Solutions whose cameras may leave for any mode of their pairs."""
    hops: int = 6
    """Modes considered for such a camera; and cells of the coarse grid, as many."""
    hop_steps: int = 6
    """Gradient steps at each before they are compared."""
    finalists: int = 2
    """Solutions that are refined, and"""
    reach: float = 0.25
    """nats a pair by which they may lie below the best one."""
    radii: tuple[float, ...] = tuple(math.radians(a) for a in (12, 6, 3, 6, 4, 3, 2, 1))
    """Neighbourhood of each sweep over their cameras, rad; wider again once all have moved."""
    last_radii: tuple[float, ...] = tuple(math.radians(a) for a in (2, 1.5, 1, 0.5, 0.25, 0.12, 0.06))
    """The same for the winner alone, at the end."""
    distinct: float = math.radians(10)
    """Solutions are different where some camera differs by more, rad."""

    def many(self, count: int, pairs: int) -> int:
        """A number of solutions for so many pairs: the fewer these are, the less a solution costs."""
        return min(self.most, round(count * self.full_scan / pairs))


@dataclass(frozen=True, eq=False)
class JointSolutions:
    """Distinct local maxima of the joint energy, best first."""

    rotations: torch.Tensor
    """(S, N, 3, 3) float64, camera_from_object, the first camera the identity."""
    scores: torch.Tensor
    """(S,) float64: sum of the pairs' energies."""


def joint_scores(energies: PairEnergies, rotations: torch.Tensor) -> torch.Tensor:
    """Sum over pairs of the energy of ``R_j R_i^T``. (S, N, 3, 3) -> (S,) float64; differentiable."""
    relative = rotations[:, energies.j] @ rotations[:, energies.i].mT  # (S, P, 3, 3)
    values = energies.at(torch.arange(energies.count), relative.transpose(0, 1))
    return values.double().sum(0)


def solve(
    energies: PairEnergies, distributions: PairDistributions, settings: AscentSettings = AscentSettings()
) -> JointSolutions:
    """The joint maximum and the other local maxima that were met on the way."""
    count = settings.many(settings.starts, energies.count)
    jumping = settings.many(settings.jumpers, energies.count)
    grown = _grow(energies, distributions, 0, settings)
    starts, scores = _climbed(energies, grown, jumping, settings)
    refined, rounds = starts[:0], 0
    if distributions.mode_energies[:, 0].sum() - scores[0] > settings.content * energies.count:
        # One beam favours what its first pairs agree on: each camera's turn as the root has another order.
        roots = range(1, energies.views)
        more = [_grow(energies, distributions, root, settings) for root in roots]
        starts, _ = _climbed(energies, grown, count, settings)
        starts, _ = _climbed(energies, torch.cat([starts, *more]), count, settings)
        jumped = torch.cat([_jump(energies, distributions, starts[:jumping], settings), starts])
        finalists = settings.many(settings.finalists, energies.count)
        refined, scores = _best(energies, jumped, finalists, settings.distinct)
        refined = refined[scores > scores[0] - settings.reach * energies.count]
        for radius in settings.radii:
            refined = _sweep(energies, refined, radius)
        rounds = settings.many(1, energies.count) - 1
    # Jumps may all end on one hill: where they started is kept beside, for a runner-up to be told.
    rotations, _ = _best(energies, torch.cat([refined, starts]), count, settings.distinct)
    winner = rotations[:1]
    for turn in range(rounds):  # where pairs are few, which costs little, ripples are searched more than once
        for radius in settings.radii:
            winner = _sweep(energies, winner, radius, turn + 1.0)
    for radius in settings.last_radii:
        winner = _sweep(energies, winner, radius)
    rotations, scores = _best(energies, torch.cat([winner, rotations[1:]]), count, settings.distinct)
    return JointSolutions(rotations, scores)


def _climbed(
    energies: PairEnergies, rotations: torch.Tensor, count: int, settings: AscentSettings
) -> tuple[torch.Tensor, torch.Tensor]:
    """The best distinct ones of some solutions, climbed; best first. -> (S, N, 3, 3), (S,)."""
    rotations, _ = _best(energies, rotations, count, settings.distinct)
    rotations = _climb(energies, rotations, settings.climb_stride, settings.climb_steps)
    return _best(energies, rotations, count, settings.distinct)


def _best(
    energies: PairEnergies, rotations: torch.Tensor, count: int, angle: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The best distinct ones of some solutions, the first camera turned to the identity, best first.

    -> (<= count, N, 3, 3), (<= count,).
    """
    rotations = rotations @ rotations[:, :1].mT
    scores = joint_scores(energies, rotations)
    keep = _distinct(rotations, scores, count, angle)
    return rotations[keep], scores[keep]


def spanning_order(strengths: torch.Tensor, pair_of: torch.Tensor, root: int = 0) -> list[int]:
    """Cameras in the order in which a maximum spanning tree reaches them from the root (Prim).

    Args:
        strengths: (P,) of the pairs.
        pair_of: (N, N) position of each pair.
        root: the camera to begin with.
    """
    table = strengths[pair_of].fill_diagonal_(-math.inf)
    order = [root]
    left = [camera for camera in range(len(table)) if camera != root]
    while left:
        reach = [float(table[order, camera].max()) for camera in left]
        order.append(left.pop(reach.index(max(reach))))
    return order


def _grow(
    energies: PairEnergies, distributions: PairDistributions, root: int, settings: AscentSettings
) -> torch.Tensor:
    """A beam of complete starts. -> (B, N, 3, 3)."""
    order = spanning_order(distributions.mode_log_densities[:, 0], energies.pair_of, root)
    width = settings.many(settings.beam, energies.count)
    beam = torch.eye(3, dtype=torch.float64).expand(1, energies.views, 3, 3).clone()
    scores = torch.zeros(1, dtype=torch.float64)
    for position in range(1, len(order)):
        camera, placed = order[position], order[:position]
        candidates = _mode_candidates(energies, distributions, beam, camera, placed)  # (B, C, 3, 3)
        parents = torch.arange(len(beam)).repeat_interleave(candidates.shape[1])
        candidates = candidates.flatten(0, 1)
        if len(candidates) > settings.screened:
            guesses = _remembered(
                energies, distributions, beam, camera, placed, candidates.view(len(beam), -1, 3, 3)
            )
            by_guess = torch.argsort((scores[:, None] + guesses).flatten(), descending=True, stable=True)
            parents, candidates = (each[by_guess[: settings.screened]] for each in (parents, candidates))
        grown = beam[parents]
        gains = _conditional(energies, grown, camera, placed, candidates[:, None])[:, 0]
        grown[:, camera] = candidates
        totals = scores[parents] + gains
        keep = _distinct(grown[:, order[: position + 1]], totals, width, settings.distinct)
        beam, scores = grown[keep], totals[keep]
    return beam


def _mode_candidates(
    energies: PairEnergies,
    distributions: PairDistributions,
    rotations: torch.Tensor,
    camera: int,
    others: list[int],
) -> torch.Tensor:
    """Where the modes of its pairs with the others would put a camera. (S, N, 3, 3) -> (S, C, 3, 3)."""
    parts = []
    for other in others:
        pair = int(energies.pair_of[camera, other])
        modes = distributions.modes[pair][distributions.mode_energies[pair] > -math.inf]
        camera_from_other = modes if camera > other else modes.mT
        parts.append(camera_from_other @ rotations[:, other, None])
    return torch.cat(parts, 1)


def _conditional(
    energies: PairEnergies, rotations: torch.Tensor, camera: int, others: list[int], candidates: torch.Tensor
) -> torch.Tensor:
    """Energy of one camera's pairs at each candidate, the others held.

    (S, N, 3, 3) and (S, C, 3, 3) -> (S, C).
    """
    pairs = energies.pair_of[camera, others]
    placed = rotations[:, others].transpose(0, 1)[:, :, None]  # (O, S, 1, 3, 3)
    relative = candidates @ placed.mT  # (O, S, C, 3, 3): camera from other
    forward = torch.tensor([camera > other for other in others])[:, None, None, None, None]
    relative = torch.where(forward, relative, relative.mT)
    return energies.at(pairs, relative.flatten(1, 2)).double().sum(0).view(candidates.shape[:2])


def _distinct(rotations: torch.Tensor, scores: torch.Tensor, count: int, angle: float) -> torch.Tensor:
    """Positions of the best solutions of which no two agree in all cameras, best first.

    (S, N, 3, 3) and (S,) -> (<= count,).
    """
    least_trace = 1 + 2 * math.cos(angle)
    flat = rotations.flatten(2)  # (S, N, 9)
    left = scores.clone()
    keep: list[int] = []
    while len(keep) < count:
        best = int(left.argmax())
        if left[best] == -math.inf:
            break
        keep.append(best)
        traces = (flat * flat[best]).sum(-1).min(1).values
        left = left.masked_fill(traces > least_trace, -math.inf)
        left[best] = -math.inf
    return torch.tensor(keep)


def _neighbourhood() -> torch.Tensor:
    """Tangent offsets: the centre, 26 directions on the unit sphere, the six axes at half. -> (33, 3)."""
    axis = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    cube = torch.cartesian_prod(axis, axis, axis)
    length = cube.norm(dim=1, keepdim=True)
    edge = cube[length[:, 0] > 0] / length[length[:, 0] > 0]
    axes = cube[(length[:, 0] > 0) & (length[:, 0] < 1.1)] / 2
    return torch.cat([torch.zeros(1, 3, dtype=torch.float64), edge, axes])


_NEIGHBOURHOOD = _neighbourhood()


def _jump(
    energies: PairEnergies,
    distributions: PairDistributions,
    rotations: torch.Tensor,
    settings: AscentSettings,
) -> torch.Tensor:
    """Moves every camera in turn to the best hill, wherever it is. (S, N, 3, 3) -> (S, N, 3, 3).

    Modes of its pairs and cells of the coarse grid only say where to start climbing: what all pairs of a
    camera agree on may be the top of none of them.
    """
    rotations = rotations.clone()
    for camera in range(energies.views):
        others = [other for other in range(energies.views) if other != camera]
        ceiling = distributions.mode_energies[energies.pair_of[camera, others], 0].sum()
        now = _conditional(energies, rotations, camera, others, rotations[:, camera, None])[:, 0]
        restless = (ceiling - now > settings.content * len(others)).nonzero()[:, 0]
        if len(restless) == 0:
            continue
        moving = rotations[restless]
        modes = _mode_candidates(energies, distributions, moving, camera, others)
        gains = _conditional(energies, moving, camera, others, modes)
        cells = distributions.coarse_rotations.expand(len(moving), -1, -1, -1)
        guesses = _remembered(energies, distributions, moving, camera, others, cells)
        starts = torch.cat(
            [
                pick(modes, peaks(modes, gains, settings.hops, settings.distinct)[0]),
                pick(cells, peaks(cells, guesses, settings.hops, settings.distinct)[0]),
            ],
            1,
        )
        hills, heights = _climb_camera(energies, moving, camera, others, starts, settings)
        hills = torch.cat([moving[:, camera, None], hills], 1)
        heights = torch.cat([now[restless, None], heights], 1)
        rotations[restless, camera] = hills[torch.arange(len(moving)), heights.argmax(1)]
    return rotations


def _climb_camera(
    energies: PairEnergies,
    rotations: torch.Tensor,
    camera: int,
    others: list[int],
    starts: torch.Tensor,
    settings: AscentSettings,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Climbs one camera from each of its starts, the others held. (S, C, 3, 3) -> the same, and (S, C)."""

    def height(places: torch.Tensor) -> torch.Tensor:
        return _conditional(energies, rotations, camera, others, places.view_as(starts)).flatten()

    strides = torch.full((starts.shape[0] * starts.shape[1],), settings.climb_stride, dtype=torch.float64)
    hills, heights = ascend(height, starts.flatten(0, 1), strides, settings.hop_steps)
    return hills.view_as(starts), heights.view(starts.shape[:2])


def _remembered(
    energies: PairEnergies,
    distributions: PairDistributions,
    rotations: torch.Tensor,
    camera: int,
    others: list[int],
    candidates: torch.Tensor,
) -> torch.Tensor:
    """What the coarse grid remembers of `_conditional`. (S, N, 3, 3) and (S, C, 3, 3) -> (S, C).

    No energy is evaluated: each relative rotation takes the value of the cell that it falls nearest to.
    """
    cells = distributions.coarse_rotations.flatten(1).float()
    totals = torch.zeros(candidates.shape[:2], dtype=torch.float64)
    for other in others:
        relative = candidates @ rotations[:, other, None].mT  # (S, C, 3, 3)
        if camera < other:
            relative = relative.mT
        likeness = relative.flatten(2).float() @ cells.T  # traces; numpy finds their maxima ten times sooner
        nearest = torch.from_numpy(likeness.numpy().argmax(-1))
        totals += distributions.coarse[energies.pair_of[camera, other]][nearest]
    return totals


def _sweep(energies: PairEnergies, rotations: torch.Tensor, radius: float, turn: float = 0.0) -> torch.Tensor:
    """Moves every camera in turn to the best place around it. (S, N, 3, 3) -> (S, N, 3, 3).

    Places lie at other directions for another ``turn``, rad.
    """
    rotations = rotations.clone()
    turned = _NEIGHBOURHOOD @ so3.exp_tensor(torch.tensor([turn, turn, 0.0], dtype=torch.float64))
    offsets = so3.exp_tensor(turned * radius)  # the first is the identity: no camera gets worse
    rows = torch.arange(len(rotations))
    for camera in range(energies.views):
        others = [other for other in range(energies.views) if other != camera]
        candidates = offsets @ rotations[:, camera, None]
        gains = _conditional(energies, rotations, camera, others, candidates)
        rotations[:, camera] = candidates[rows, gains.argmax(1)]
    return rotations


def _climb(energies: PairEnergies, rotations: torch.Tensor, stride: float, steps: int) -> torch.Tensor:
    """Climbs all rotations together along the joint gradient (Adam's scaling, best point kept)."""
    here, best = rotations, rotations
    best_score = torch.full((len(rotations),), -math.inf, dtype=torch.float64)
    first = torch.zeros(*rotations.shape[:2], 3, dtype=torch.float64)
    second = torch.zeros_like(first)
    for step in range(steps + 1):
        with torch.enable_grad():
            tangent = torch.zeros_like(first, requires_grad=True)
            scores = joint_scores(energies, so3.exp_tensor(tangent) @ here)
            (slope,) = torch.autograd.grad(scores.sum(), tangent)
        scores = scores.detach()
        better = scores > best_score
        best = torch.where(better[:, None, None, None], here, best)
        best_score = torch.where(better, scores, best_score)
        first = 0.8 * first + 0.2 * slope
        second = 0.95 * second + 0.05 * slope**2
        scale = (first / (1 - 0.8 ** (step + 1))) / ((second / (1 - 0.95 ** (step + 1))).sqrt() + 1e-9)
        here = so3.exp_tensor(stride * (1 - step / steps) * scale) @ here
    return best
