"""Fitting what turns a network's energies into probabilities that hold, on captures it was not trained on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count, cycle, islice
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.evaluation import match_trust
from relpose_ros.evaluation.calibration_fit import LEVELS, fit_calibration, measure_calibration, observe
from relpose_ros.evaluation.match_trust import MatchedPairs, fit_trust, measure_trust
from relpose_ros.evaluation.protocol import EvaluationError, view_orders
from relpose_ros.inference.calibration import Calibration
from relpose_ros.inference.estimator import Estimator
from relpose_ros.inference.outlines import find_outline
from relpose_ros.inference.pair_energies import GridEmbeddings
from relpose_ros.inference.predictions import predicted_translations
from relpose_ros.network.checkpoint import load_network, read_metadata, write_network
from relpose_ros.views import Scan

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from relpose_ros.evaluation.calibration_fit import CalibrationReport, Observation
    from relpose_ros.evaluation.match_trust import TrustReport
    from relpose_ros.evaluation.protocol import PosedViews
    from relpose_ros.network.relpose import RelPose

VIEWS = (3, 4, 5, 8)
"""Numbers of views that take turns; fewer where a capture has fewer."""
SCANS = 24
"""A group, to fit on; as many others to measure on."""
LEAST_FLAT = 0.2
"""How often a network may be plainly wrong of a pair at least, whatever the fit says: a robot's objects are
not those of the fit, and pairs that are surely wrong together outvote all else. With 0.05 the 90 % ellipsoids
of scans where network and matches are joined held 79 to 85 % of the rotations, with 0.2 of the same weights
86 to 94 %, at the same accuracy."""

LEAST_SIGMA = (0.04, 0.1)
"""How well positions may be known at most before matches tell more, whatever the fit says: a detector's boxes
are not those of the fit, and an object is cut off. With 0.012 and 0.07 the 90 % ellipsoids of renderings that
are not centred held 91 % at eight views and of photographs 85 % at five, with these 96 and 93 %."""

Reports = dict[str, tuple["CalibrationReport", "CalibrationReport"]]
"""By group: uncalibrated and calibrated."""


@dataclass(frozen=True)
class Calibrated:
    """A calibration, and what it is worth on other scans than it was fitted on."""

    calibration: Calibration
    reports: Reports
    trust: TrustReport | None
    """Of matches that the network's descriptors help to; None where it has none, or too few matched."""


def calibrate(
    groups: Mapping[str, Sequence[PosedViews]],
    weights: Path,
    output: Path,
    *,
    scans: int = SCANS,
    seed: int = 0,
    half: bool = False,
    progress: bool = True,
) -> Calibrated:
    """Fits a calibration, measures it on other scans of the same captures, and stores it with the weights.

    That of a network with local descriptors says, too, how far to trust the matches that they help to.

    Args:
        groups: Captures by a name. All groups count the same; the captures of one take turns, drawn at random
            where they are more than the scans.
        weights: Network file to calibrate; a calibration that it holds is not looked at.
        output: Safetensors file to write, with all else that ``weights`` says of itself.
        scans: Of each group, to fit on, and again to measure on.
        seed: Of the scans.
        half: Write the weights in float16.
        progress: Whether to show a progress bar on stderr.

    Raises:
        EvaluationError: No captures or no scans, no folder for the output, or a network that regresses
            poses, which has no probabilities.
        NetworkFileError: Weights cannot be loaded or written.
    """
    from tqdm import tqdm

    if not groups or not all(groups.values()):
        raise EvaluationError("no capture was given to calibrate on; name at least one with camera poses.")
    if scans < 1:
        raise EvaluationError(f"{scans} scans of each are no number to fit on; ask for 1 or more.")
    if not output.parent.is_dir():
        raise EvaluationError(f"{output} cannot be written: {output.parent} is no folder; make it first.")
    network = load_network(weights)
    if network.preset.rotation == "regression":
        text = f"{weights} regresses poses and states no probabilities; there is nothing to calibrate."
        raise EvaluationError(text)
    fitted_on: list[_Observed] = []
    others: dict[str, list[_Observed]] = {}
    with tqdm(total=2 * scans * len(groups), unit="scan", disable=not progress) as bar:
        observed = _observer(network, bar.update)
        for name, captures in groups.items():
            bar.set_postfix_str(name)
            drawn = _scans(captures, seed)
            fitted_on += [observed(*scan) for scan in islice(drawn, scans)]
            others[name] = [observed(*scan) for scan in islice(drawn, scans)]
    calibration = fit_calibration([each.scan for each in fitted_on], LEAST_FLAT, LEAST_SIGMA)
    trust = fit_trust(MatchedPairs.joined([each.matched for each in fitted_on]))
    calibration = replace(calibration, match_trust=trust)
    metadata = {**read_metadata(weights), "calibration": calibration.to_json()}
    write_network(network, output, metadata, half=half)
    reports = {}
    for name, group in others.items():
        scans_of = [each.scan for each in group]
        reports[name] = (
            measure_calibration(scans_of, Calibration()),
            measure_calibration(scans_of, calibration),
        )
    matched = MatchedPairs.joined([each.matched for group in others.values() for each in group])
    return Calibrated(calibration, reports, None if trust is None else measure_trust(matched, trust))


def _scans(captures: Sequence[PosedViews], seed: int) -> Iterator[tuple[PosedViews, list[int]]]:
    """Endless scans: each round takes every capture once, in a random order, the numbers of views in turn."""
    generator = np.random.default_rng(seed)
    counts = cycle(VIEWS)
    for turn in count():
        for k in generator.permutation(len(captures)):
            capture, views = captures[k], next(counts)
            size = len(capture.camera_from_world)
            (order,) = view_orders(capture.name, size, views, orders=1, seed=seed * 1_000_003 + turn)
            yield capture, order


@dataclass(frozen=True, eq=False)
class _Observed:
    """A scan by the network, and its pairs by the matches that its descriptors help to."""

    scan: Observation
    matched: MatchedPairs


def _observer(
    network: RelPose, on_scan: Callable[[], object]
) -> Callable[[PosedViews, list[int]], _Observed]:
    estimator, grid = Estimator(network), GridEmbeddings(network)

    def observed(capture: PosedViews, order: list[int]) -> _Observed:
        views = tuple(capture.view(k) for k in order)
        features = estimator.features(Scan(capture.name, views))
        poses = capture.camera_from_world[order]
        translations = predicted_translations(network, features, poses[:, :, :3] @ poses[0, :, :3].T)
        outlines = [find_outline(view) for view in views]
        scan = observe(network, grid, features, translations, outlines, poses[:, :, :3], poses[:, :, 3])
        has_descriptors = network.preset.correlation is not None
        matched = match_trust.observe(views if has_descriptors else (), poses[:, :, :3], estimator)
        on_scan()
        return _Observed(scan, matched)

    return observed


def trust_line(trust: TrustReport | None) -> str:
    """How far matches are trusted that the network's descriptors help to, as a sentence for a terminal."""
    if trust is None:
        return (
            "SIFT will match alone: no descriptors, or too few matched pairs to learn how far to trust them."
        )
    return (
        f"Its descriptors help to match: of {trust.pairs} pairs {trust.right:.0%} were right, "
        f"{trust.stated:.0%} was stated, calibration error {trust.expected_calibration_error:.3f}."
    )


def calibration_table(reports: Reports) -> str:
    """What the calibration is worth, as text for a terminal: before -> after, a column a group."""
    rows: dict[str, list[str]] = {"": list(reports)}
    for before, after in reports.values():
        for label, old, new in zip(_LABELS, _figures(before), _figures(after), strict=True):
            rows.setdefault(label, []).append(old if old == new else f"{old} -> {new}")
    widths = [max(map(len, column)) for column in zip(*([k, *v] for k, v in rows.items()), strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip([label, *cells], widths, strict=True)).rstrip()
        for label, cells in rows.items()
    )


_ELLIPSOIDS = f"inside the {' / '.join(f'{100 * level:g}' for level in LEVELS)} % ellipsoid, %"
_LABELS = (
    "pairs",
    "log density of the true rotation, nats above uniform",
    'calibration error of "within 15 degrees"',
    f"pairs {_ELLIPSOIDS}",
    f"camera rotations {_ELLIPSOIDS}",
    f"camera positions {_ELLIPSOIDS}",
)


def _figures(report: CalibrationReport) -> tuple[str, ...]:
    coverages = (report.pair_coverage, report.camera_rotation_coverage, report.camera_position_coverage)
    return (
        str(report.pairs),
        f"{report.log_likelihood:.2f}",
        f"{report.expected_calibration_error:.3f}",
        *(" / ".join(f"{100 * share:.0f}" for share in each) for each in coverages),
    )
