"""The page that shows a replay: one HTML file that needs nothing but a browser.

What is measured is computed here; the template beside this file only draws it.
"""

from __future__ import annotations

import base64
import html
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from relpose_ros.estimates import Evidence, Verdict
from relpose_ros.geometry import so3
from relpose_ros.inference.verdict import NOT_ENOUGH, ONE_MORE, rotation_deviations
from relpose_ros.replay.comparison import compare
from relpose_ros.scanning.outgoing import is_weak, view_colour
from relpose_ros.views import MAX_VIEWS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from relpose_ros.estimates import CameraPose, FloatArray, PairRotation, ScanEstimate
    from relpose_ros.replay.comparison import Comparison, TruePose
    from relpose_ros.replay.recording import EstimateRecord, Recording

TEMPLATE = Path(__file__).with_name("report_template.html")

MAX_STEPS = 100
"""Estimates that the page lets one step through; of more, evenly spread ones."""
MAX_CELLS = 320
"""Rotations drawn for a pair."""
LEAST_MASS = 2e-4
"""A rotation less probable than this would be a dot too small to see."""
DRAWS = 240
"""Rotations drawn from a pair's modes where the distribution itself is not given."""
RIGHT_WITHIN = 15.0
"""Degrees: the threshold of the paper's tables."""


@dataclass(frozen=True, eq=False)
class Cells:
    """A pair's distribution as it was computed: rotations and the probability of each."""

    rotations: FloatArray
    """(L, 3, 3), camera_j_from_camera_i."""
    probabilities: FloatArray
    """(L,), summing to one."""


def write_report(
    path: Path,
    recording: Recording,
    truth: Mapping[int, TruePose],
    rejected: Sequence[tuple[str, int]],
    bag_name: str,
    cells: Mapping[tuple[int, int], Cells] | None = None,
) -> None:
    """Write the page.

    Args:
        path: The HTML file.
        recording: Views and estimates of one object, at least one estimate.
        truth: True poses by stamp; empty where the bag has none.
        rejected: An example of each kind of rejected message, and how many there were.
        bag_name: Named in the title.
        cells: The last estimate's pair distributions; those not given are drawn from their modes.
    """
    shown = _spread_out(recording.estimates)
    comparisons = [_compare(each, truth) for each in shown]
    last, comparison = shown[-1], comparisons[-1]
    data = {
        "colours": [_css(view_colour(k)) for k in range(MAX_VIEWS)],
        "views": [
            {
                "picture": "data:image/jpeg;base64," + base64.b64encode(record.picture).decode("ascii"),
                "corners": _rounded(record.corners),
                "name": f"{(record.view.stamp_ns - recording.views[0].view.stamp_ns) / 1e9:.2f} s",
            }
            for record in recording.views
        ],
        "steps": [_step(each, errors) for each, errors in zip(shown, comparisons, strict=True)],
        "thinned": len(recording.estimates) - len(shown),
        "distributions": [
            _distribution(pair, last.estimate, comparison, (cells or {}).get((pair.i, pair.j)))
            for pair in last.estimate.pairs
        ],
        "sampled": not cells,
        "rejected": [[reason, count] for reason, count in rejected],
    }
    heading, verdict_class = _heading(last.estimate)
    texts = {
        "title": f"{recording.object_id} in {bag_name}",
        "verdict": heading,
        "verdict_class": verdict_class,
        # The verdict stands above it already.
        "status": _sentence(re.sub(f"^(enough: |{NOT_ENOUGH}|{ONE_MORE})", "", last.estimate.status)),
        "facts": " ".join(_facts(recording, last, comparison)),
    }
    page = TEMPLATE.read_text(encoding="utf-8")
    for name, text in texts.items():
        page = page.replace(f"{{{{{name}}}}}", html.escape(text))
    # "</" would end the script element that holds the data, "<!--" would change how it is parsed.
    content = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    path.write_text(page.replace("{{data}}", content), encoding="utf-8")


def yaw_pitch_roll(camera_j_from_camera_i: FloatArray) -> FloatArray:
    """How the second camera is turned as seen from the first one, degrees. (..., 3, 3) -> (..., 3).

    Yaw to the right, pitch up, then roll clockwise about its own optical axis:
    ``camera_i_from_camera_j = R_y(yaw) R_x(pitch) R_z(roll)`` in optical axes.
    """
    turned = np.swapaxes(camera_j_from_camera_i, -1, -2)
    axis = turned[..., :, 2]
    yaw = np.arctan2(axis[..., 0], axis[..., 2])
    pitch = np.arcsin(np.clip(-axis[..., 1], -1, 1))
    zero = np.zeros_like(yaw)
    level = so3.exp(np.stack([zero, yaw, zero], -1)) @ so3.exp(np.stack([pitch, zero, zero], -1))
    rolled = np.swapaxes(level, -1, -2) @ turned
    roll = np.arctan2(rolled[..., 1, 0], rolled[..., 0, 0])
    return np.asarray(np.degrees(np.stack([yaw, pitch, roll], -1)))


def _heading(estimate: ScanEstimate) -> tuple[str, str]:
    """The verdict in large letters, and the class that gives it colour and icon."""
    if estimate.verdict == Verdict.ENOUGH:
        return "Enough to act on", "enough"
    if estimate.status.startswith(ONE_MORE):
        return "One more view needed", "more"
    return "Not enough yet", "short"


def _facts(recording: Recording, last: EstimateRecord, comparison: Comparison | None) -> list[str]:
    """What a reader should know before looking at anything, as sentences."""
    count = len(recording.estimates)
    estimates = "estimate" if count == 1 else "estimates"
    facts = [
        f"{recording.arrivals()}; the last of {count} {estimates} rests on {len(last.views)}.",
        *filter(None, [_sentence(recording.lost_enough())]),
    ]
    if comparison is not None:
        errors = np.array(list(comparison.rotation_errors.values()))
        facts.append(
            f"Against the ground truth, {(errors <= RIGHT_WITHIN).sum()} of {len(errors)} relative rotations "
            f"are right to {RIGHT_WITHIN:.0f}°; their median error is {np.median(errors):.1f}°."
        )
        if comparison.centre_errors:
            typical = 100 * np.median(list(comparison.centre_errors.values()))
            facts.append(f"Camera centres are off by {typical:.0f} % of the scene's size (median).")
    if last.estimate.scale_known:
        deviation = 100 * last.estimate.scale_deviation
        facts.append(f"Positions are in metres{f', their scale to {deviation:.0f} %' if deviation else ''}.")
    else:
        facts.append("The scale is unknown: the first camera is at distance 1 from the object.")
    if not last.estimate.calibrated:
        facts.append("These weights are not calibrated, so read the probabilities as a ranking.")
    return facts


def _step(record: EstimateRecord, comparison: Comparison | None) -> dict[str, Any]:
    estimate = record.estimate
    step: dict[str, Any] = {
        "views": list(record.views),
        "enough": estimate.verdict == Verdict.ENOUGH,
        "status": _sentence(estimate.status),
        "seconds": _rounded(estimate.seconds),
        "weakest": int(estimate.weakest_pair),
        "cameras": [_camera(camera) for camera in estimate.cameras],
        "pairs": [_pair(pair, comparison) for pair in estimate.pairs],
    }
    if comparison is not None:
        step["truth"] = {str(view): _true(pose) for view, pose in comparison.aligned.items()}
        if comparison.centre_errors is not None:
            step["centres"] = {str(view): _rounded(error) for view, error in comparison.centre_errors.items()}
    return step


def _camera(camera: CameraPose) -> dict[str, Any]:
    variances, axes = np.linalg.eigh(camera.covariance[:3, :3])
    return {
        "p": _rounded(camera.position),
        "q": _rounded(so3.quaternion_xyzw(camera.object_from_camera)),
        # The half axes of the ellipsoid of one standard deviation, one a row.
        "spread": _rounded((axes * np.sqrt(np.maximum(variances, 0))).T),
        "turn": _rounded(np.degrees(rotation_deviations(camera.covariance))),
    }


def _true(pose: TruePose) -> dict[str, Any]:
    return {"p": _rounded(pose.centre), "q": _rounded(so3.quaternion_xyzw(pose.world_from_camera))}


def _pair(pair: PairRotation, comparison: Comparison | None) -> dict[str, Any]:
    error = None if comparison is None else comparison.rotation_errors.get((pair.i, pair.j))
    return {
        "i": int(pair.i),
        "j": int(pair.j),
        "sure": _rounded(pair.probability_within_15_deg),
        "agrees": _rounded(pair.solution_probability),
        "off": _rounded(np.degrees(pair.solution_angle)),
        "ambiguous": _rounded(np.degrees(pair.ambiguity_angle)) if pair.ambiguous else None,
        "weak": bool(is_weak(pair)),
        "matched": bool(pair.evidence & Evidence.GEOMETRIC),
        "entropy": _rounded(pair.entropy),
        "error": None if error is None else _rounded(error),
    }


def _distribution(
    pair: PairRotation, estimate: ScanEstimate, comparison: Comparison | None, cells: Cells | None
) -> dict[str, Any]:
    """What the figure of one pair shows: [yaw, pitch, roll, probability] of each rotation, and the marks."""
    rotations, masses = _draw(pair) if cells is None else _most_probable(cells)
    by_view = {camera.view: camera.object_from_camera for camera in estimate.cameras}
    solution = by_view[pair.j].T @ by_view[pair.i]
    points = np.concatenate([yaw_pitch_roll(rotations), masses[:, None]], axis=1)
    drawn: dict[str, Any] = {"points": _rounded(points, 4), "solution": _rounded(yaw_pitch_roll(solution), 2)}
    if comparison is not None and {pair.i, pair.j} <= set(comparison.aligned):
        true = {view: pose.world_from_camera for view, pose in comparison.aligned.items()}
        drawn["truth"] = _rounded(yaw_pitch_roll(true[pair.j].T @ true[pair.i]), 2)
    return drawn


def _most_probable(cells: Cells) -> tuple[FloatArray, FloatArray]:
    order = np.argsort(-cells.probabilities, kind="stable")[:MAX_CELLS]
    order = order[cells.probabilities[order] >= LEAST_MASS]
    return cells.rotations[order], cells.probabilities[order]


def _draw(pair: PairRotation) -> tuple[FloatArray, FloatArray]:
    """Rotations drawn from the modes' Gaussians, the same at every run, and what each stands for."""
    generator = np.random.default_rng((pair.i, pair.j))
    rotations, masses = [], []
    for mode in pair.modes:
        count = max(1, round(DRAWS * mode.weight))
        offsets = generator.multivariate_normal(np.zeros(3), mode.covariance, count, method="eigh")
        rotations.append(so3.exp(offsets) @ mode.camera_j_from_camera_i)
        masses.append(np.full(count, mode.weight / count))
    return np.concatenate(rotations), np.concatenate(masses)


def _compare(record: EstimateRecord, truth: Mapping[int, TruePose]) -> Comparison | None:
    return compare(record.estimate, [view.stamp_ns for view in record.scan.views], truth)


def _spread_out(records: Sequence[EstimateRecord]) -> list[EstimateRecord]:
    """At most ``MAX_STEPS`` of them, the first and the last among these."""
    if len(records) <= MAX_STEPS:
        return list(records)
    return [records[round(k)] for k in np.linspace(0, len(records) - 1, MAX_STEPS)]


def _sentence(status: str) -> str:
    return status[:1].upper() + status[1:].rstrip(".") + "." if status else ""


def _css(colour: tuple[float, float, float]) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in colour)


def _rounded(values: Any, digits: int = 5) -> Any:
    """Plain numbers, short: the page is read by people and travels by mail."""
    return np.round(np.asarray(values, np.float64), digits).tolist()
