"""A calibration fitted on held-out scans, and what it is worth on others.

`observe` scans with known poses, `fit_calibration`, `measure_calibration`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from relpose_ros.geometry import cameras, so3
from relpose_ros.inference.calibration import Calibration
from relpose_ros.inference.global_rotations import solve
from relpose_ros.inference.outlines import position_sigmas, sighted_translations, sightlines
from relpose_ros.inference.pair_distribution import search
from relpose_ros.inference.pair_energies import PairEnergies
from relpose_ros.inference.predictions import about_the_object
from relpose_ros.inference.uncertainty import WITHIN, camera_covariances, describe_pairs

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Any

    import numpy.typing as npt

    from relpose_ros.estimates import PairRotation
    from relpose_ros.inference.global_rotations import JointSolutions
    from relpose_ros.inference.outlines import Outline
    from relpose_ros.inference.pair_distribution import PairDistributions
    from relpose_ros.inference.pair_energies import EnergyModel, GridEmbeddings

    FloatArray = npt.NDArray[np.float64]

LEVELS = (0.5, 0.9, 0.95)
"""Nominal coverages that are reported."""
CHI_SQUARE_3 = (2.366, 6.251, 7.815)
"""Quantiles of the chi-square distribution with three degrees of freedom at those levels."""
BINS = 10
"""Of predicted probability, for the expected calibration error."""
FLAT_SHARES = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3)
"""Shares of the uniform distribution that are tried."""
TEMPERATURES = (1 / 32, 32.0)
"""Range in which the temperature is looked for. The log-likelihood of a share is concave in 1/T."""


@dataclass(frozen=True, eq=False)
class Observation:
    """One held-out scan: what the network and the solver made of it, and the truth."""

    energies: PairEnergies
    distributions: PairDistributions
    solutions: JointSolutions
    outlines: tuple[Outline | None, ...]
    predicted: FloatArray
    """(N, 3) translations camera_from_object by the network, the first at distance 1."""
    true_rotations: FloatArray
    """(N, 3, 3) camera_from_object, the first the identity."""
    true_translations: FloatArray
    """(N, 3), the first at distance 1."""
    energy_at_truth: torch.Tensor
    """(P,) float64."""

    def translations(self, calibration: Calibration) -> FloatArray:
        """(N, 3) what a calibration goes by."""
        return sighted_translations(self.outlines) if calibration.placed_by_boxes else self.predicted


@dataclass(frozen=True)
class CalibrationReport:
    """How well stated probabilities and covariances hold on some scans."""

    pairs: int
    log_likelihood: float
    """Mean over pairs of the log density of the truth, nats relative to uniform."""
    expected_calibration_error: float
    """Of "within 15 degrees of the strongest mode", 0 to 1."""
    pair_coverage: tuple[float, ...]
    """Share of pairs whose truth lies in the 50, 90 and 95% ellipsoid of the covariance."""
    camera_rotation_coverage: tuple[float, ...]
    """The same of cameras' rotations, the gauge camera left out."""
    camera_position_coverage: tuple[float, ...]
    """The same of cameras' positions."""


def observe(
    model: EnergyModel,
    grid: GridEmbeddings,
    features: Any,
    translations: FloatArray,
    outlines: Sequence[Outline | None],
    true_rotations: FloatArray,
    true_translations: FloatArray,
) -> Observation:
    """Solves a held-out scan and keeps what a calibration needs of it.

    Args:
        model: the network.
        grid: its embeddings of the rotation grid, shared by all scans.
        features: of the scan's N views.
        translations: (N, 3) predicted, camera_from_object, optical, about where the optical axes meet.
        outlines: where the cameras see the object.
        true_rotations: (N, 3, 3) camera_from_object in any object frame.
        true_translations: (N, 3) in the same frame, any unit.
    """
    seen = sightlines(outlines)
    about_object, _, _ = cameras.look_at_translations(true_rotations, true_translations, seen)
    rotations = true_rotations @ true_rotations[0].T
    with torch.no_grad():
        energies = PairEnergies.of(model, features, len(rotations))
        distributions = search(energies, grid)
        truth = torch.from_numpy(rotations)
        relative = truth[energies.j] @ truth[energies.i].mT
        at_truth = energies.at(torch.arange(energies.count), relative[:, None])[:, 0].double()
        solutions = solve(energies, distributions)
    predicted = about_the_object(rotations, translations, outlines)
    return Observation(
        *(energies, distributions, solutions, tuple(outlines)),
        *(predicted, rotations, about_object, at_truth),
    )


def log_likelihood(observations: Sequence[Observation], temperature: float, flat: float) -> float:
    """Mean over all pairs of the log density of the truth relative to uniform, nats.

    Args:
        observations: Held-out scans.
        temperature: By which energies are divided.
        flat: Share of the uniform distribution.
    """
    return _mean_log(_densities(observations, temperature), flat)


def _densities(observations: Sequence[Observation], temperature: float) -> torch.Tensor:
    """The network's own density of the truth relative to uniform, of all pairs. -> (P,)."""
    parts = [
        o.energy_at_truth / temperature - o.distributions.log_normaliser(temperature) for o in observations
    ]
    return torch.cat(parts).exp()


def _mean_log(densities: torch.Tensor, flat: float) -> float:
    return float(((1 - flat) * densities + flat).clamp_min(1e-30).log().mean())


def fit_calibration(
    observations: Sequence[Observation],
    least_flat: float = 0.0,
    least_sigma: tuple[float, float] = (1e-3, 1e-3),
) -> Calibration:
    """The temperature with the highest likelihood of the truth, then factors that make 90% ellipsoids hold.

    A factor is kept only where it brings the coverages at 50, 90 and 95% nearer to their names.

    Args:
        observations: Held-out scans.
        least_flat: Of the shares of the uniform distribution, the least that may be.
        least_sigma: Of the standard deviations of positions, likewise.
    """
    shares = [share for share in FLAT_SHARES if share >= least_flat]

    def best(temperature: float) -> tuple[float, float]:
        densities = _densities(observations, temperature)
        return max((_mean_log(densities, share), share) for share in shares)

    temperature = _maximise(lambda t: best(t)[0], *TEMPERATURES)
    flat = best(temperature)[1]
    by_network, by_boxes = (
        _position_sigma(observations, Calibration(placed_by_boxes=by)) for by in (False, True)
    )
    by = _volume(by_boxes) < _volume(by_network)
    across, along = np.maximum(by_boxes if by else by_network, least_sigma).tolist()
    calibration = Calibration(temperature, placed_by_boxes=by, position_sigma=(across, along), flat=flat)
    pair_squares, rotation_squares, _ = _mahalanobis_squares(observations, calibration)
    return replace(calibration, pair_spread=_spread(pair_squares), rotation_spread=_spread(rotation_squares))


def measure_calibration(observations: Sequence[Observation], calibration: Calibration) -> CalibrationReport:
    """What a calibration is worth, best asked of scans that it was not fitted on."""
    stated, right = [], []
    for observation in observations:
        for pair in _pairs(observation, calibration):
            stated.append(pair.probability_within_15_deg)
            right.append(_angle_to_truth(observation, pair.i, pair.j, pair.camera_j_from_camera_i) < WITHIN)
    pair_squares, rotation_squares, position_squares = _mahalanobis_squares(observations, calibration)
    return CalibrationReport(
        pairs=len(stated),
        log_likelihood=log_likelihood(observations, calibration.temperature, calibration.flat),
        expected_calibration_error=expected_calibration_error(np.array(stated), np.array(right)),
        pair_coverage=coverage(pair_squares),
        camera_rotation_coverage=coverage(rotation_squares),
        camera_position_coverage=coverage(position_squares),
    )


def expected_calibration_error(stated: FloatArray, right: npt.NDArray[np.bool_]) -> float:
    """Mean distance between stated probabilities and frequencies, over bins of equal width. (K,), (K,)."""
    bins = np.minimum((stated * BINS).astype(int), BINS - 1)
    gaps = [
        (bins == which).sum() * abs(stated[bins == which].mean() - right[bins == which].mean())
        for which in np.unique(bins)
    ]
    return float(sum(gaps) / len(stated))


def _pairs(observation: Observation, calibration: Calibration) -> tuple[PairRotation, ...]:
    best = observation.solutions.rotations[0]
    return describe_pairs(observation.distributions, observation.energies, best, calibration)


def _true_relative(observation: Observation, i: int, j: int) -> FloatArray:
    return np.asarray(observation.true_rotations[j] @ observation.true_rotations[i].T)


def _angle_to_truth(observation: Observation, i: int, j: int, rotation: FloatArray) -> float:
    return float(so3.angle_between(_true_relative(observation, i, j), rotation))


def _mahalanobis_squares(
    observations: Sequence[Observation], calibration: Calibration
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Squared errors in units of the stated covariances: of pairs, camera rotations and camera positions."""
    of_pairs, of_rotations, of_positions = [], [], []
    for observation in observations:
        for pair in _pairs(observation, calibration):
            truth = _true_relative(observation, pair.i, pair.j)
            of_pairs.append(
                mahalanobis_square(so3.log(truth @ pair.camera_j_from_camera_i.T), pair.covariance)
            )
        translations = observation.translations(calibration)
        with torch.no_grad():
            covariances = camera_covariances(
                observation.distributions,
                observation.energies,
                observation.solutions.rotations[0],
                translations,
                calibration,
                position_sigmas(observation.outlines, calibration.position_sigma),
            )
        rotations = observation.solutions.rotations[0].numpy()
        centres = cameras.camera_centre(rotations, translations)
        true_centres = cameras.camera_centre(observation.true_rotations, observation.true_translations)
        for camera in range(1, len(rotations)):
            turn = so3.log(observation.true_rotations[camera].T @ rotations[camera])  # axes of the object
            of_rotations.append(mahalanobis_square(turn, covariances[camera, 3:, 3:]))
            shift = true_centres[camera] - centres[camera]
            of_positions.append(mahalanobis_square(shift, covariances[camera, :3, :3]))
    return np.array(of_pairs), np.array(of_rotations), np.array(of_positions)


def mahalanobis_square(error: FloatArray, covariance: FloatArray) -> float:
    """Squared length of an error in units of its covariance. (3,), (3, 3)."""
    return float(error @ np.linalg.solve(covariance, error))


def coverage(squares: FloatArray) -> tuple[float, ...]:
    """Shares of errors inside the ellipsoids of `LEVELS`, by `mahalanobis_square`. (K,) -> one a level."""
    return tuple(float((squares <= quantile).mean()) for quantile in CHI_SQUARE_3)


def _spread(squares: FloatArray) -> float:
    factor = float(np.quantile(squares, LEVELS[1])) / CHI_SQUARE_3[1]

    def miss(coverage: tuple[float, ...]) -> float:
        return sum(abs(got - wanted) for got, wanted in zip(coverage, LEVELS, strict=True))

    return factor if miss(coverage(squares / factor)) < miss(coverage(squares)) else 1.0


def _position_sigma(observations: Sequence[Observation], calibration: Calibration) -> tuple[float, float]:
    """From 90% quantiles across and along the line of sight: a few gross errors should not widen all."""
    across, along = [], []
    for each in observations:
        translations = each.translations(calibration)
        errors = translations - each.true_translations
        rays = translations / np.linalg.norm(translations, axis=1, keepdims=True)
        ahead = (errors * rays).sum(1)
        across.append(np.linalg.norm(errors - ahead[:, None] * rays, axis=1))
        along.append(np.abs(ahead[1:]))  # the first camera's distance is the unit
    # In a plane the 90% quantile of the distance is 2.146 standard deviations, on a line 1.645.
    quantiles = [float(np.quantile(np.concatenate(parts), 0.9)) for parts in (across, along)]
    return quantiles[0] / 2.146, quantiles[1] / 1.645


def _volume(sigma: tuple[float, float]) -> float:
    """Of the ellipsoid of positions, up to a factor."""
    return sigma[0] ** 2 * sigma[1]


def _maximise(height: Callable[[float], float], low: float, high: float) -> float:
    """Golden-section search of a function with one maximum, on a logarithmic scale, to one per cent."""
    ratio = (math.sqrt(5) - 1) / 2
    a, b = math.log(low), math.log(high)
    left, right = b - ratio * (b - a), a + ratio * (b - a)
    at_left, at_right = height(math.exp(left)), height(math.exp(right))
    while b - a > 0.01:
        if at_left > at_right:
            b, right, at_right = right, left, at_left
            left = b - ratio * (b - a)
            at_left = height(math.exp(left))
        else:
            a, left, at_left = left, right, at_right
            right = a + ratio * (b - a)
            at_right = height(math.exp(right))
    return math.exp((a + b) / 2)
