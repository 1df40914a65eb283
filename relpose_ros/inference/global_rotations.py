"""One rotation per camera that all pairs agree with best: the joint maximum of the pairs' energies.

Cameras join in the order of a maximum spanning tree over the pairs' modes. Where RelPose++ keeps one
rotation per camera (the best mode along the tree), a beam of partial solutions is kept here, each camera
tried at every mode of every pair that ties it to those already placed. The best ends climb, all rotations
together along the gradient. Where pairs still contradict each other, beams grow from the other cameras too,
and cameras jump to other hills. The best end is polished by a search of shrinking neighbourhoods.

All cameras are tried at once, each against the others as they are; `_moved` then says which of them move
together. So a step costs a few calls of many rotations instead of many calls of few.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from relpose_ros.geometry import so3, so3_grid
from relpose_ros.inference.moving_cameras import MovingCameras
from relpose_ros.inference.pair_distribution import ascend, highest_apart, pick, turned, turned_back

if TYPE_CHECKING:
    from relpose_ros.inference.pair_distribution import PairDistributions
    from relpose_ros.inference.pair_energies import PairEnergies


@dataclass(frozen=True)
class AscentSettings:
    """How the joint maximum is looked for.

    Numbers of solutions, places, rounds and turns are for a full scan: smaller ones, which are cheap, have
    more, see `many`.
    """

    full_scan: int = 28
    """Pairs that those numbers are meant for, 8 views."""
    most: int = 32
    """What `many` gives at most."""
    beam: int = 8
    """Partial solutions kept while cameras join."""
    screened: int = 5
    """Ways to add a camera that are evaluated for each one kept, the best by the coarse grid's memory."""
    modes: int = 8
    """Modes of each pair at which a camera may join, the highest."""
    starts: int = 4
    """Complete solutions that climb, and are reported."""
    climb_stride: float = math.radians(8)
    """First step of a climb, rad."""
    climb_steps: int = 8
    content: float = 0.5
    """Nats a pair. Where the pairs of a scan, or of a camera, are on average this near to their highest
    modes, no other place is looked for: the best could gain no more. Scans whose pairs agree become cheap."""
    torn: float = 1.5
    """The same: beyond it, two cameras join anew and solutions are refined before they are compared."""
    jumps: int = 2
    """Times that cameras may leave for another hill, while that gains anything."""
    jumpers: int = 2
    """Solutions whose cameras may leave for another hill, one by one and two by two."""
    hops: int = 24
    """Places considered for a single camera, the best by what the coarse grid remembers."""
    hills: int = 2
    """The best of them, which climb before they are compared."""
    hop_stride: float = math.radians(3)
    """First step of that climb, rad."""
    hop_steps: int = 4
    rounds: float = 1
    """Times that any two cameras join anew, while that gains anything, at least once."""
    joining: int = 2
    """Partial solutions kept while two cameras join anew."""
    finalists: int = 2
    """Solutions that are refined."""
    turns: float = 0.2
    """Times that they are refined, each time in other directions, at least once."""
    radii: tuple[float, ...] = tuple(math.radians(a) for a in (12, 6, 3))
    """Neighbourhood of each sweep over their cameras, rad."""
    most_winners: int = 2
    """Solutions that are polished at the end: one of a full scan, of smaller ones at most so many."""
    most_polishes: int = 2
    """Times that these are polished, likewise."""
    settled: float = 1e-4
    """Nats: where a polish gains less, another one would gain no more."""
    last_radii: tuple[float, ...] = tuple(math.radians(a) for a in (8, 4, 2, 1, 0.5, 0.2, 0.08))
    """Neighbourhood of each of those sweeps, rad."""
    distinct: float = math.radians(10)
    """Solutions are different where some camera differs by more, rad."""

    def many(self, count: float, pairs: int) -> int:
        """A number of solutions for so many pairs: the fewer these are, the less a solution costs."""
        return max(1, min(self.most, round(count * self.full_scan / pairs)))


@dataclass(frozen=True, eq=False)
class JointSolutions:
    """Distinct local maxima of the joint energy, best first."""

    rotations: torch.Tensor
    """(S, N, 3, 3) float64, camera_from_object, the first camera the identity."""
    scores: torch.Tensor
    """(S,) float64: sum of the pairs' energies."""


def joint_scores(energies: PairEnergies, rotations: torch.Tensor) -> torch.Tensor:
    """Sum over pairs of the energy of ``R_j R_i^T``. (S, N, 3, 3) -> (S,) float64."""
    values = energies.at(torch.arange(energies.count), _all_relative(energies, rotations))
    return values.double().sum(0)


def joint_uphill(energies: PairEnergies, rotations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """`joint_scores` and their gradients for left perturbations of each camera. -> (S,), (S, N, 3)."""
    relative = _all_relative(energies, rotations)
    values, slopes = energies.uphill(torch.arange(energies.count), relative)
    # A turn w of camera i turns the pair by -R_ji w.
    by_camera = torch.zeros(energies.views, len(rotations), 3, dtype=torch.float64)
    by_camera.index_add_(0, energies.j, slopes)
    by_camera.index_add_(0, energies.i, turned_back(relative, slopes))
    return values.sum(0), by_camera.transpose(0, 1)


def _all_relative(energies: PairEnergies, rotations: torch.Tensor) -> torch.Tensor:
    """Each pair's relative rotation. (S, N, 3, 3) -> (P, S, 3, 3)."""
    cameras = rotations.transpose(0, 1)
    return cameras[energies.j] @ cameras[energies.i].mT


def solve(
    energies: PairEnergies, distributions: PairDistributions, settings: AscentSettings = AscentSettings()
) -> JointSolutions:
    """The joint maximum and the other local maxima that were met on the way."""
    count, jumpers = (settings.many(each, energies.count) for each in (settings.starts, settings.jumpers))
    # The energies that are added up may weigh less than those that the modes were found in.
    tops = energies.at(torch.arange(energies.count), distributions.modes[:, :1])[:, 0].double()
    grown = _grown(energies, distributions, [0], settings)
    found, scores = _climbed(energies, grown, jumpers, settings)
    ceiling = tops.sum()
    if ceiling - scores[0] > settings.content * energies.count:
        # One beam favours what its first pairs agree on: each camera's turn as the root has another order.
        more = _grown(energies, distributions, list(range(1, energies.views)), settings)
        found, _ = _climbed(energies, torch.cat([found, grown, more]), count, settings)
        best, scores = found, joint_scores(energies, found)
        for _ in range(settings.jumps):
            before = scores[0]
            jumped = _jumped(energies, distributions, best[:jumpers], tops, settings)
            best, scores = _climbed(energies, torch.cat([best, jumped]), jumpers, settings)
            if scores[0] <= before:
                break
        if ceiling - scores[0] > settings.torn * energies.count:
            best = _refined(energies, distributions, best, scores, settings)
        # All may end on one hill: where they started is kept beside, for a runner-up to be told.
        found, scores = _best(energies, torch.cat([best, found]), count, settings.distinct)
    last, polishes = (
        min(most, settings.many(1, energies.count))
        for most in (settings.most_winners, settings.most_polishes)
    )
    winners, scores = found[:last], scores[:last]
    for turn in range(polishes):
        if turn > 0:
            before, scores = scores, joint_scores(energies, winners)
            if (scores - before).max() < settings.settled:
                break
        for radius in settings.last_radii:
            winners = _swept(energies, winners, radius, float(turn))
    return JointSolutions(*_best(energies, torch.cat([winners, found[last:]]), count, settings.distinct))


def _refined(
    energies: PairEnergies,
    distributions: PairDistributions,
    best: torch.Tensor,
    scores: torch.Tensor,
    settings: AscentSettings,
) -> torch.Tensor:
    """Solutions with any two cameras joined anew, the best of them refined. -> (<= S, N, 3, 3)."""
    jumpers, finalists, turns, rounds = (
        settings.many(each, energies.count)
        for each in (settings.jumpers, settings.finalists, settings.turns, settings.rounds)
    )
    for _ in range(rounds):
        before = scores[0]
        joined = _rejoined(energies, distributions, best, settings)
        best, scores = _climbed(energies, torch.cat([best, joined]), jumpers, settings)
        if scores[0] <= before:
            break
    best = best[:finalists]
    for turn in range(turns):
        for radius in settings.radii:
            best = _swept(energies, best, radius, float(turn))
    return best


def _climbed(
    energies: PairEnergies, rotations: torch.Tensor, count: int, settings: AscentSettings
) -> tuple[torch.Tensor, torch.Tensor]:
    """The best distinct ones of some solutions, climbed; best first. -> (S, N, 3, 3), (S,)."""
    rotations, _ = _best(energies, rotations, count, settings.distinct)
    rotations = _climb(energies, rotations, settings.climb_stride, settings.climb_steps)
    return _best(energies, rotations, count, settings.distinct)


def _climb(energies: PairEnergies, rotations: torch.Tensor, stride: float, steps: int) -> torch.Tensor:
    """Climbs all rotations together along the joint gradient (Adam's scaling, best point kept)."""
    here, best = rotations, rotations
    best_score = torch.full((len(rotations),), -math.inf, dtype=torch.float64)
    first = torch.zeros(*rotations.shape[:2], 3, dtype=torch.float64)
    second = torch.zeros_like(first)
    for step in range(steps + 1):
        scores, slope = joint_uphill(energies, here)
        better = scores > best_score
        best = torch.where(better[:, None, None, None], here, best)
        best_score = torch.where(better, scores, best_score)
        first = 0.8 * first + 0.2 * slope
        second = 0.95 * second + 0.05 * slope**2
        scale = (first / (1 - 0.8 ** (step + 1))) / ((second / (1 - 0.95 ** (step + 1))).sqrt() + 1e-9)
        here = turned(here, stride * (1 - step / steps) * scale)
    return best


def _best(
    energies: PairEnergies, rotations: torch.Tensor, count: int, angle: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The best distinct ones of some solutions, the first camera turned to the identity, best first.

    -> (<= count, N, 3, 3), (<= count,).
    """
    rotations = rotations @ rotations[:, :1].mT
    keep, scores = highest_apart(rotations[None], joint_scores(energies, rotations)[None], count, angle)
    found = scores[0] > -math.inf
    return rotations[keep[0, found]], scores[0, found]


def spanning_order(strengths: torch.Tensor, pair_of: torch.Tensor, root: int = 0) -> list[int]:
    """Cameras in the order in which a maximum spanning tree reaches them from the root (Prim).

    Args:
        strengths: (P,) of the pairs.
        pair_of: (N, N) position of each pair.
        root: the camera to begin with.
    """
    table = strengths[pair_of].fill_diagonal_(-math.inf).tolist()
    order = [root]
    left = [camera for camera in range(len(table)) if camera != root]
    while left:
        reach = [max(table[placed][camera] for placed in order) for camera in left]
        order.append(left.pop(reach.index(max(reach))))
    return order


def _grown(
    energies: PairEnergies, distributions: PairDistributions, roots: list[int], settings: AscentSettings
) -> torch.Tensor:
    """Complete starts, a beam of them from each root. -> (B, N, 3, 3)."""
    strengths = distributions.mode_log_densities[:, 0]
    orders = torch.tensor([spanning_order(strengths, energies.pair_of, root) for root in roots])
    alone = torch.eye(3, dtype=torch.float64).expand(len(roots), energies.views, 3, 3)
    width = settings.many(settings.beam, energies.count)
    return _grow(energies, distributions, alone, orders, 1, width, settings)


def _rejoined(
    energies: PairEnergies,
    distributions: PairDistributions,
    rotations: torch.Tensor,
    settings: AscentSettings,
) -> torch.Tensor:
    """Solutions with any two cameras taken out and joined anew. (S, N, 3, 3) -> (B, N, 3, 3)."""
    placed = max(1, energies.views - 2)
    width = settings.many(settings.joining, energies.count)
    orders = [
        [camera for camera in range(energies.views) if camera not in out] + list(out)
        for out in itertools.combinations(range(energies.views), energies.views - placed)
    ]
    starts = rotations.repeat_interleave(len(orders), 0)
    every = torch.tensor(orders).repeat(len(rotations), 1)
    return _grow(energies, distributions, starts, every, placed, width, settings)


def _grow(
    energies: PairEnergies,
    distributions: PairDistributions,
    starts: torch.Tensor,
    orders: torch.Tensor,
    placed: int,
    width: int,
    settings: AscentSettings,
) -> torch.Tensor:
    """Beams of solutions to which cameras join in turn, at the modes of their pairs with those before them.

    Args:
        energies: of the scan.
        distributions: of its pairs.
        starts: (T, N, 3, 3), one for each beam.
        orders: (T, N) the cameras.
        placed: how many of them stay where they are at the start.
        width: partial solutions kept in each beam.
        settings: how many are evaluated for it.

    Returns:
        (B, N, 3, 3), those of all beams.
    """
    beams = starts[:, None]
    scores = torch.zeros(beams.shape[:2], dtype=torch.float64)
    trees = torch.arange(len(beams))[:, None]
    for position in range(placed, energies.views):
        cameras, others = orders[:, position], orders[:, :position]
        joining = MovingCameras(energies, beams, cameras, others)
        candidates = joining.where_modes_put(distributions.modes[:, : settings.modes])  # (T, B, C, 3, 3)
        guesses = scores[..., None] + joining.remembered(distributions, candidates)
        # Lower modes beside higher ones come last, where there is still room.
        heights = distributions.mode_energies[joining.pairs, : settings.modes]
        guesses = guesses.masked_fill((heights == -math.inf).flatten(1)[:, None], -math.inf).flatten(1)
        chosen = guesses.sort(dim=1, descending=True, stable=True).indices[:, : settings.screened * width]
        parents, places = chosen // candidates.shape[2], pick(candidates.flatten(1, 2), chosen)
        beams = beams[trees, parents]
        gains = replace(joining, rotations=beams).heights(places[:, :, None])[..., 0]
        totals = scores.gather(1, parents) + gains
        beams[trees, torch.arange(chosen.shape[1]), cameras[:, None]] = places
        keep, scores = highest_apart(beams, totals, width, settings.distinct)
        beams = beams[trees, keep]
    return beams[scores > -math.inf]


def _neighbourhood() -> torch.Tensor:
    """Tangent offsets: the centre, 26 directions on the unit sphere, the six axes at half. -> (33, 3)."""
    axis = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    cube = torch.cartesian_prod(axis, axis, axis)
    length = cube.norm(dim=1, keepdim=True)
    edge = cube[length[:, 0] > 0] / length[length[:, 0] > 0]
    axes = cube[(length[:, 0] > 0) & (length[:, 0] < 1.1)] / 2
    return torch.cat([torch.zeros(1, 3, dtype=torch.float64), edge, axes])


_NEIGHBOURHOOD = _neighbourhood()


def _jumped(
    energies: PairEnergies,
    distributions: PairDistributions,
    rotations: torch.Tensor,
    tops: torch.Tensor,
    settings: AscentSettings,
) -> torch.Tensor:
    """Moves cameras to the best hills, wherever they are. (S, N, 3, 3) -> (B, N, 3, 3), see `_moved`.

    Modes of its pairs and cells of the coarse grid only say where to start climbing: what all pairs of a
    camera agree on may be the top of none of them.
    """
    moving = MovingCameras.each(energies, rotations)
    now = moving.heights(moving.here)
    restless = tops[moving.pairs].sum(1) - now.amin((1, 2)) > settings.content * (energies.views - 1)
    if not restless.any():
        return rotations
    moving, now = moving.only(restless), now[restless]
    cells = torch.tensor(so3_grid.grid(distributions.coarse_level))
    modes = moving.where_modes_put(distributions.modes)
    places = torch.cat([modes, cells.expand(*modes.shape[:2], -1, -1, -1)], 2)
    guesses = moving.remembered(distributions, places)
    places = _highest(places, guesses, settings.many(settings.hops, energies.count), settings.distinct)
    hills = settings.many(settings.hills, energies.count)
    starts = _highest(places, moving.heights(places), hills, settings.distinct)
    strides = torch.full(starts.shape[:3], settings.hop_stride, dtype=torch.float64)
    tops_of_hills, heights = ascend(moving.uphill, starts, strides, settings.hop_steps)
    places, heights = torch.cat([moving.here, tops_of_hills], 2), torch.cat([now, heights], 2)
    return _moved(rotations, moving.cameras, places, heights).flatten(0, 1)


def _swept(energies: PairEnergies, rotations: torch.Tensor, radius: float, phase: float) -> torch.Tensor:
    """Moves cameras to the best places around them. (S, N, 3, 3) -> (S, N, 3, 3).

    Places lie in other directions for another ``phase``, rad.
    """
    moving = MovingCameras.each(energies, rotations)
    directions = _NEIGHBOURHOOD @ torch.from_numpy(so3.exp([phase, phase, 0.0]))
    places = turned(moving.here, directions * radius)  # the first is where the camera is
    moved = _moved(rotations, moving.cameras, places, moving.heights(places))
    scores = joint_scores(energies, moved.flatten(0, 1)).view(moved.shape[:2])
    return moved[torch.arange(len(moved)), scores.argmax(1)]


def _highest(places: torch.Tensor, values: torch.Tensor, count: int, angle: float) -> torch.Tensor:
    """The best distinct ones of a camera's places. (G, S, C, 3, 3), (G, S, C) -> (G, S, <= count, 3, 3)."""
    flat = places.flatten(0, 1)
    kept = pick(flat, highest_apart(flat, values.flatten(0, 1), count, angle)[0])
    return kept.view(*places.shape[:2], -1, 3, 3)


def _moved(
    rotations: torch.Tensor, cameras: torch.Tensor, places: torch.Tensor, heights: torch.Tensor
) -> torch.Tensor:
    """Solutions with no camera moved, with the one that gains most at its best place, with two, and so on.

    What a camera gains holds while the others stay, so that it may be one too many.

    Args:
        rotations: (S, N, 3, 3).
        cameras: (G,).
        places: (G, S, C, 3, 3) for each camera, the first where it is.
        heights: (G, S, C) its energies there.

    Returns:
        (S, G + 1, N, 3, 3).
    """
    solutions = torch.arange(len(rotations))
    best = heights.argmax(2)  # (G, S)
    gains = heights.gather(2, best[..., None])[..., 0] - heights[..., 0]
    order = gains.sort(dim=0, descending=True, stable=True).indices
    moved = rotations[:, None].repeat(1, len(cameras) + 1, 1, 1, 1)
    for rank, group in enumerate(order, start=1):
        moved[solutions, rank:, cameras[group]] = places[group, solutions, best[group, solutions]][:, None]
    return moved
