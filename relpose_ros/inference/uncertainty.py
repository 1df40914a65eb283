"""How far to trust an estimate: what each pair knows, each camera's covariance, and how they agree."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import torch

from relpose_ros.estimates import Evidence, Mode, PairRotation
from relpose_ros.geometry import so3
from relpose_ros.inference.groups import groups
from relpose_ros.inference.pair_distribution import pick
from relpose_ros.inference.rotation_evidence import FREEDOM

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.inference.calibration import Calibration
    from relpose_ros.inference.pair_distribution import PairDistributions
    from relpose_ros.inference.pair_energies import PairEnergies

    FloatArray = npt.NDArray[np.float64]

WITHIN = math.radians(15)
"""The radius of "within 15 degrees", the field's usual measure of a right rotation."""
BASIN = math.radians(30)
"""A mode owns the probability nearer to it than to any other mode, up to this angle: beyond it lies what no
mode explains, so that a flat distribution has modes of hardly any weight."""
LEAST_MODE_WEIGHT = 0.02
"""Modes below it are not reported: they are ripples."""
RUNNER_UP_WEIGHT = 0.15
"""A second mode matters from here on: about one chance in seven of being the true one."""
SURE = 0.85
"""Probability around the final poses from which on a matched pair's gross errors are told as a probability
alone."""
CORE_ROUNDS = 6
"""Of reweighting; the scatter then changes by less than a thousandth."""
OF_GAUSSIAN = 0.756
"""Variance that a Student's t of `FREEDOM` finds in a Gaussian of variance one, in three dimensions."""
SOLVER_FLOOR = math.radians(0.1)
"""The solver's own accuracy, rad: the standard deviation stated for what the gauge fixes by definition."""
UNIFORM_VARIANCE = (math.pi**2 / 3 + 2) / 3
"""Of each component of a rotation vector whose rotation may be any, rad^2: angles a have density
(1 - cos a) / pi."""
UNTIED = 1e-6
"""Information, rad^-2, of a camera that no pair tells anything of: as good as none."""


def describe_pairs(
    distributions: PairDistributions,
    energies: PairEnergies,
    solution: torch.Tensor,
    calibration: Calibration,
) -> tuple[PairRotation, ...]:
    """Every pair's modes, spread and entropy, and how the final rotations agree with it.

    Args:
        distributions: of the P pairs.
        energies: which views a pair is of.
        solution: (N, 3, 3) float64 camera_from_object.
        calibration: of the network.
    """
    solved = solution[energies.j] @ solution[energies.i].mT
    masses = distributions.masses(calibration.temperature, calibration.flat)
    entropies = -(masses * (masses.clamp_min(1e-300).log() - distributions.log_volumes)).sum(1)
    basins = _basins(distributions, masses)
    weights, by_weight = basins.weights.sort(dim=1, descending=True, stable=True)
    heavy = weights >= LEAST_MODE_WEIGHT
    heavy[:, 0] = True
    evidence = [_evidence(energies, pair) for pair in range(energies.count)]
    # Fitted where the network speaks alone; the width of a matched peak is fitted by itself.
    widening = np.array([1.0 if Evidence.GEOMETRIC in each else calibration.pair_spread for each in evidence])
    cores = _cores(distributions, basins, torch.zeros_like(heavy).scatter_(1, by_weight, heavy))
    cores = np.take_along_axis(cores, by_weight.numpy()[..., None, None], 1) * widening[:, None, None, None]
    centres = pick(distributions.modes, by_weight)
    covariances = _second_moments(distributions, centres[:, 0], masses) * widening[:, None, None]
    within = _share(distributions, masses, centres[:, 0])
    agreeing = _share(distributions, masses, solved)
    to_modes = _turned_by(_traces(solved[:, None], centres)[:, 0].masked_fill(~heavy, -math.inf).amax(1))
    pairs = []
    for pair, count in enumerate(heavy.sum(1).tolist()):
        modes = tuple(
            Mode(camera_j_from_camera_i=centre, weight=weight, covariance=core)
            for centre, weight, core in zip(
                centres[pair, :count].numpy(),
                weights[pair, :count].tolist(),
                cores[pair, :count],
                strict=True,
            )
        )
        ambiguous = count > 1 and modes[1].weight >= RUNNER_UP_WEIGHT
        pairs.append(
            PairRotation(
                i=int(energies.i[pair]),
                j=int(energies.j[pair]),
                camera_j_from_camera_i=modes[0].camera_j_from_camera_i,
                covariance=covariances[pair],
                entropy=float(entropies[pair]),
                probability_within_15_deg=float(within[pair]),
                modes=modes,
                ambiguous=ambiguous,
                ambiguity_angle=_angle(modes[0], modes[1]) if ambiguous else 0.0,
                solution_probability=float(agreeing[pair]),
                solution_angle=float(to_modes[pair]),
                evidence=evidence[pair],
            )
        )
    return tuple(pairs)


def heaviest_modes(distributions: PairDistributions) -> PairDistributions:
    """The same distributions with nothing but the mode of each pair that owns the most probability."""
    heaviest = _basins(distributions, distributions.masses()).weights.argmax(1, keepdim=True)
    return replace(
        distributions,
        modes=pick(distributions.modes, heaviest),
        mode_energies=distributions.mode_energies.gather(1, heaviest),
    )


def pairs_of_unknown_trust(rotations: FloatArray) -> tuple[PairRotation, ...]:
    """Every pair of poses that came without a distribution: all that is sure is the uniform one.

    Args:
        rotations: (N, 3, 3) camera_from_object.
    """
    covariance = UNIFORM_VARIANCE * np.eye(3)
    within = float(so3.ball_fraction(WITHIN))
    pairs = []
    for i, j in combinations(range(len(rotations)), 2):
        relative = rotations[j] @ rotations[i].T
        pairs.append(
            PairRotation(
                i=i,
                j=j,
                camera_j_from_camera_i=relative,
                covariance=covariance,
                entropy=0.0,
                probability_within_15_deg=within,
                modes=(Mode(relative, float(so3.ball_fraction(BASIN)), covariance),),
                ambiguous=False,
                ambiguity_angle=0.0,
                solution_probability=within,
                solution_angle=0.0,
            )
        )
    return tuple(pairs)


@dataclass(frozen=True, eq=False)
class _Basins:
    """Who owns the masses of P pairs in L cells, of M modes."""

    owners: torch.Tensor
    """(P, L) int64, the mode nearest to each cell."""
    owned: torch.Tensor
    """(P, L) what it owns of the cell's mass."""
    weights: torch.Tensor
    """(P, M) what each mode owns."""


def _basins(distributions: PairDistributions, masses: torch.Tensor) -> _Basins:
    angles, owners = _nearest_modes(distributions, distributions.rotations)
    owned = _inside(angles, BASIN, distributions.spacings) * masses
    weights = torch.zeros_like(distributions.mode_energies).scatter_add_(1, owners, owned)
    return _Basins(owners, owned, weights)


def _nearest_modes(
    distributions: PairDistributions, rotations: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Angles to each pair's nearest mode, rad, and which it is. (P, K, 3, 3) -> (P, K) twice."""
    lacking = distributions.mode_energies == -math.inf
    traces = _traces(rotations, distributions.modes).masked_fill(lacking[:, None], -math.inf)
    highest, nearest = traces.max(2)
    return _turned_by(highest), nearest


def _evidence(energies: PairEnergies, pair: int) -> Evidence:
    learned = Evidence.LEARNED if energies.temperature < math.inf else Evidence(0)
    spoken = energies.evidence is not None and energies.evidence.spoken[pair]
    return learned | Evidence.GEOMETRIC if spoken else learned


def _angle(a: Mode, b: Mode) -> float:
    return float(so3.angle_between(a.camera_j_from_camera_i, b.camera_j_from_camera_i))


def _angles(rotations: torch.Tensor, centre: torch.Tensor) -> torch.Tensor:
    """From one rotation for each pair, in rad. (P, L, 3, 3), (P, 3, 3) -> (P, L)."""
    return _turned_by(_traces(rotations, centre[:, None])[..., 0])


def _traces(rotations: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """Of all relative rotations. (P, L, 3, 3), (P, M, 3, 3) -> (P, L, M)."""
    return rotations.flatten(2) @ centres.flatten(2).mT


def _turned_by(traces: torch.Tensor) -> torch.Tensor:
    """The angles of rotations, by their traces."""
    return ((traces - 1) / 2).clamp(-1, 1).acos()


def _inside(angles: torch.Tensor, radius: float, spacings: torch.Tensor) -> torch.Tensor:
    """Which share of each cell lies within a radius of a rotation, the border taken as flat.

    (..., L), (L,) -> (..., L).
    """
    return ((radius - angles) / spacings + 0.5).clamp(0, 1)


def _share(distributions: PairDistributions, masses: torch.Tensor, rotations: torch.Tensor) -> torch.Tensor:
    """Probability within 15 degrees of one rotation for each pair. (P, L), (P, 3, 3) -> (P,)."""
    angles = _angles(distributions.rotations, rotations)
    return (_inside(angles, WITHIN, distributions.spacings) * masses).sum(1)


def _second_moments(
    distributions: PairDistributions, centres: torch.Tensor, masses: torch.Tensor
) -> FloatArray:
    """Of each pair's rotation vector from its centre, left perturbation, over its masses.

    (P, 3, 3), (P, L) -> (P, 3, 3) rad^2.
    """
    from_centres = (distributions.rotations.flatten(1, 2) @ centres.mT).view_as(distributions.rotations)
    vectors = _turns(from_centres)
    moments = (masses[..., None] * vectors).mT @ vectors / masses.sum(1)[:, None, None]
    return moments.numpy() + _least_moment(distributions)


def _cores(distributions: PairDistributions, basins: _Basins, told: torch.Tensor) -> FloatArray:
    """As `_second_moments`, of the cores of some of the modes. (P, M) bool -> (P, M, 3, 3) rad^2.

    Of the others, and of one that owns no mass, the least there is.

    The further out, the less the mass counts.

    The scatter of the Student's t that suits the masses best (Kent and Tyler 1991), in the measure in which a
    Gaussian has its own covariance. A few near misses, degrees off, would be most of a second moment, and
    hide how exact the rest is.
    """
    # Logarithms of the rest would be work for nothing.
    used = basins.owned > 1e-9 * basins.owned.amax(1, keepdim=True)
    pairs, cells = (used & told.gather(1, basins.owners)).nonzero(as_tuple=True)
    # The cells of one mode together.
    by_mode, order = (pairs * told.shape[1] + basins.owners[pairs, cells]).sort(stable=True)
    modes, starts, group = np.unique(by_mode.numpy(), return_index=True, return_inverse=True)
    pairs, cells = pairs[order], cells[order]
    owners = basins.owners[pairs, cells]
    from_owner = distributions.rotations[pairs, cells] @ distributions.modes[pairs, owners].mT
    vectors = _turns(from_owner).numpy()
    squares = (vectors[:, :, None] * vectors[:, None, :]).reshape(-1, 9)
    share = basins.owned[pairs, cells].numpy()
    share = share / np.add.reduceat(share, starts)[group]
    least = _least_moment(distributions).reshape(9)
    scatter = np.add.reduceat(share[:, None] * squares, starts) + least
    for _ in range(CORE_ROUNDS):
        information = np.linalg.inv(scatter.reshape(-1, 3, 3)).reshape(-1, 9)
        distances = np.einsum("ka,ka->k", information[group], squares)
        weights = share * (FREEDOM + 3) / (FREEDOM + distances)
        # At the end the weights sum to one; made so in every round, they get there sooner (Kent et al. 1994).
        weights /= np.add.reduceat(weights, starts)[group]
        scatter = np.add.reduceat(weights[:, None] * squares, starts) + least
    cores = np.tile(least, (told.numel(), 1))
    cores[modes] = scatter
    return cores.reshape(*told.shape, 3, 3) / OF_GAUSSIAN


def _least_moment(distributions: PairDistributions) -> FloatArray:
    """A peak inside one cell is not sharper than the cell."""
    return np.asarray(float(distributions.spacings.min()) ** 2 / 12 * np.eye(3))


def _about(
    distributions: PairDistributions, energies: PairEnergies, relative: torch.Tensor, masses: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The masses (P, L) of which each pair's covariance about the final relative pose (P, 3, 3) is taken.

    A small chance of a gross error, far away, would be most of a second moment. Where a pair's matches agree
    with the final poses that chance is told apart, as a probability, and only the mass within `BASIN` of them
    counts. Which pairs those are comes second, (P,).
    """
    if energies.evidence is None:
        return masses, torch.zeros(energies.count, dtype=torch.bool)
    angles = _angles(distributions.rotations, relative)
    near = _inside(angles, BASIN, distributions.spacings) * masses
    sure = torch.tensor(energies.evidence.spoken) & (near.sum(1) >= SURE)
    return torch.where(sure[:, None], near, masses), sure


def _independence(energies: PairEnergies, sure: torch.Tensor) -> FloatArray:
    """Which part of each pair's information counts, (P,), in the sum over a scan.

    Every view takes part in N - 1 pairs, whose errors are therefore not N - 1 independent ones: the sum is
    divided by N / 2, which is exact where each view has one error of its own. Views that sure pairs tie
    together see the same side: what the network mistakes in one it mistakes in the others. Between two such
    groups the mean of the pairs counts, as if each group were one view.
    """
    tied = sure.numpy()
    if not tied.any():  # the network alone does without SciPy
        return np.full(energies.count, 2 / energies.views)
    i, j = energies.i.numpy(), energies.j.numpy()
    group = groups(i[tied], j[tied], energies.views)
    sizes = np.bincount(group)
    within = group[i] == group[j]
    return np.where(within, 2 / energies.views, 2 / len(sizes) / (sizes[group[i]] * sizes[group[j]]))


def _turns(rotations: torch.Tensor) -> torch.Tensor:
    """As `so3.log`, sooner: straight from the skew part, but where that vanishes. (..., 3, 3) -> (..., 3)."""
    skew = rotations - rotations.mT
    axes = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1) / 2  # of length sin(angle)
    sine = axes.norm(dim=-1)
    angle = torch.atan2(sine, (rotations.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2)
    vectors: torch.Tensor = axes * (angle / sine.clamp_min(1e-12))[..., None]
    hard = sine < 1e-3
    if hard.any():
        vectors[hard] = torch.from_numpy(so3.log(rotations[hard].numpy()))
    return vectors


def camera_covariances(
    distributions: PairDistributions,
    energies: PairEnergies,
    solution: torch.Tensor,
    translations: FloatArray,
    calibration: Calibration,
    sigmas: FloatArray,
) -> FloatArray:
    """Covariance of every camera in the object frame, as geometry_msgs/PoseWithCovariance orders it.

    Each pair is taken as the Gaussian with its second moment about the final poses' relative rotation. For a
    pair with one sharp peak there, this is its energy's curvature; a pair with other modes, or one that
    disagrees, holds its cameras the less. Curvature alone would call an ambiguous pair certain.

    Args:
        distributions: of the P pairs.
        energies: which views a pair is of.
        solution: (N, 3, 3) float64 camera_from_object.
        translations: (N, 3) camera_from_object, in units of the first camera's distance.
        calibration: of the network.
        sigmas: (N, 2) of the translations, as `outlines.position_sigmas` has them.

    Returns:
        (N, 6, 6): x, y, z, rotation about X, Y, Z, fixed axes of the object frame.
    """
    spread = _joint_spread(distributions, energies, solution, calibration)
    return _in_object_frame(spread, solution.numpy(), translations, sigmas)


def covariances_of_unknown_trust(
    rotations: FloatArray, translations: FloatArray, sigmas: FloatArray
) -> FloatArray:
    """As `camera_covariances`, of poses that came without a distribution.

    Any camera but the first, which the gauge fixes, may look any way.

    Args:
        rotations: (N, 3, 3) camera_from_object.
        translations: (N, 3), as there.
        sigmas: (N, 2), as there.
    """
    spread = np.repeat(UNIFORM_VARIANCE * np.eye(3)[None], len(rotations), 0)
    spread[0] = 0
    return _in_object_frame(spread, rotations, translations, sigmas)


def _in_object_frame(
    spread: FloatArray, rotations: FloatArray, translations: FloatArray, sigmas: FloatArray
) -> FloatArray:
    """Covariances (N, 6, 6) of poses from those of their rotations, (N, 3, 3) in the cameras' own axes."""
    spread = spread + SOLVER_FLOOR**2 * np.eye(3)
    across, along = np.square(sigmas).T[..., None, None]
    # By definition of the unit of length the first camera's distance is one.
    along[0] = SOLVER_FLOOR**2
    rays = translations / np.maximum(np.linalg.norm(translations, axis=1, keepdims=True), 1e-9)
    shifts = across * np.eye(3) + (along - across) * rays[:, :, None] * rays[:, None, :]
    covariances = np.zeros((len(rotations), 6, 6))
    for camera, object_from_camera in enumerate(rotations.transpose(0, 2, 1)):
        # A turn e of the camera (axes of the camera, left perturbation of camera_from_object) is the turn
        # -R^T e in the object's axes, and moves the centre -R^T t by -R^T (t x e).
        jacobian = np.concatenate([-object_from_camera @ so3.hat(translations[camera]), -object_from_camera])
        covariances[camera] = jacobian @ spread[camera] @ jacobian.T
        # To second order a turn e also moves it by e x (e x t) / 2: along the ray, where turns are large.
        bend = (np.trace(spread[camera]) * np.eye(3) - spread[camera]) @ translations[camera] / 2
        bend *= min(
            1.0, 2 * float(np.linalg.norm(translations[camera])) / max(float(np.linalg.norm(bend)), 1e-9)
        )
        shift = shifts[camera] + np.outer(bend, bend)
        covariances[camera, :3, :3] += object_from_camera @ shift @ object_from_camera.T
    return np.asarray((covariances + covariances.transpose(0, 2, 1)) / 2)


def _joint_spread(
    distributions: PairDistributions,
    energies: PairEnergies,
    solution: torch.Tensor,
    calibration: Calibration,
) -> FloatArray:
    """Covariance of each camera's turn in its own axes, the first camera held. -> (N, 3, 3) rad^2.

    With R_ij = R_j R_i^T, turns e_i and e_j of the cameras turn R_ij by e_j - R_ij e_i.

    A pair that may have any rotation has a covariance too, that of the uniform distribution. That much is
    taken off what each pair tells, and given back to each camera once, as the mean of its pairs: however many
    say nothing, together they say no more.
    """
    relative = solution[energies.j] @ solution[energies.i].mT
    masses = distributions.masses(calibration.temperature, calibration.flat)
    information = UNTIED * np.eye(3 * energies.views)
    given_back = np.zeros((energies.views, 3, 3))
    about, sure = _about(distributions, energies, relative, masses)
    moments = _second_moments(distributions, relative, about)
    shares = _independence(energies, sure)
    for pair, (i, j) in enumerate(zip(energies.i.tolist(), energies.j.tolist(), strict=True)):
        variances, axes = np.linalg.eigh(moments[pair])
        nothing = axes / np.maximum(variances, UNIFORM_VARIANCE) @ axes.T
        told = shares[pair] * (axes / variances @ axes.T - nothing)
        turned = relative[pair].numpy()
        given_back[i] += turned.T @ nothing @ turned / (energies.views - 1)
        given_back[j] += nothing / (energies.views - 1)
        jacobian = np.zeros((3, 3 * energies.views))
        jacobian[:, 3 * i : 3 * i + 3] = -turned
        jacobian[:, 3 * j : 3 * j + 3] = np.eye(3)
        information += jacobian.T @ told @ jacobian
    joint = np.linalg.inv(information[3:, 3:])
    spread = np.zeros((energies.views, 3, 3))
    for camera in range(1, energies.views):
        own = joint[3 * camera - 3 : 3 * camera, 3 * camera - 3 : 3 * camera]
        spread[camera] = calibration.rotation_spread * np.linalg.inv(np.linalg.inv(own) + given_back[camera])
    return spread
