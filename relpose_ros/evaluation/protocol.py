"""The paper's evaluation: seeded orders of a capture's views, each read 2, 3, ... views deep."""

from __future__ import annotations

import json
import time
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from relpose_ros.errors import RelPoseError
from relpose_ros.evaluation import baselines, metrics
from relpose_ros.geometry.cameras import camera_centre
from relpose_ros.inference.evidence import EvidenceSettings
from relpose_ros.views import MAX_VIEWS, MIN_VIEWS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    import numpy.typing as npt

    from relpose_ros.captures.folder import Capture
    from relpose_ros.views import View

    FloatArray = npt.NDArray[np.float64]

Row = dict[str, Any]
"""One line of the result: capture, method, views, scans, the figures of `metrics.summary`, seconds."""

METHODS = (
    *("relpose", "relpose-known", "both", "learned", "geometry"),
    *("constant-translation", "identity", "colmap"),
)
"""relpose is the estimator as it ships: the network, matches and refinement; relpose-known its cameras that
it calls known itself. both leaves out the refinement, learned the matches too, geometry the network."""
DERIVED = {"relpose-known": "relpose", "constant-translation": "learned"}
"""Methods that change the answer of another one."""
EVIDENCE = {
    "relpose": EvidenceSettings("refine"),
    "both": EvidenceSettings("pairs"),
    "learned": EvidenceSettings("network"),
    "geometry": EvidenceSettings("pairs", learned=False),
}
"""What the estimator rests on in each of these methods."""
ORDERS = 5
"""Random orders a capture, as in the paper."""
MEAN = "mean"
"""The ``capture`` of the rows that average over captures."""
SHOWN = (
    "rotation@15",
    "rotation@30",
    "rotation@median",
    "center@0.1",
    "center@0.2",
    "translation@0.1",
    "seconds",
)
"""The columns of a table; the JSON has all figures."""


class EvaluationError(RelPoseError):
    """Nothing can be measured on what was given."""


@dataclass(frozen=True, eq=False)
class PosedViews:
    """The views of one object, read when asked for, and where their cameras truly stood."""

    name: str
    camera_from_world: FloatArray
    """(M, 3, 4), any world and unit."""
    view: Callable[[int], View]
    """The k-th view."""


@dataclass(frozen=True, eq=False)
class _ScanErrors:
    rotation: FloatArray
    center: FloatArray
    translation: FloatArray
    seconds: float


def posed_views(capture: Capture, *, masked: bool = True) -> PosedViews:
    """The photos of a capture whose pose is known.

    Args:
        capture: Of a folder, or of CO3D.
        masked: Whether the views carry their masks.

    Raises:
        EvaluationError: Fewer than two photos have a pose.
    """
    known = [k for k, photo in enumerate(capture.photos) if photo.camera_from_world is not None]
    if len(known) < MIN_VIEWS:
        text = f"{capture.folder} has {len(known)} photos with a pose; measuring needs {MIN_VIEWS} or more."
        raise EvaluationError(text)
    poses = [pose for photo in capture.photos if (pose := photo.camera_from_world) is not None]
    return PosedViews(capture.name, np.stack(poses), lambda k: capture.view(known[k], masked=masked))


def view_orders(
    name: str, count: int, length: int, *, orders: int = ORDERS, seed: int = 0
) -> list[list[int]]:
    """Random orders of a capture's views; the first N of an order are the scan of N views.

    The draw depends on the seed and the capture's name alone, so that leaving out a capture, a method or
    a number of views changes no other figure.

    Args:
        name: The capture's.
        count: Number of its views.
        length: Views an order; fewer where the capture has fewer.
        orders: How many.
        seed: Of the draw.
    """
    generator = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return [[int(k) for k in generator.permutation(count)[:length]] for _ in range(orders)]


def measure(
    sequence: PosedViews,
    methods: Sequence[baselines.Method],
    views: Sequence[int] = range(MIN_VIEWS, MAX_VIEWS + 1),
    *,
    orders: int = ORDERS,
    seed: int = 0,
    on_scan: Callable[[], object] = lambda: None,
) -> list[Row]:
    """Methods on one capture: a row for each and every number of views the capture has enough photos for.

    Args:
        sequence: The capture.
        methods: What estimates. All get the same `View` objects, in the same order.
        views: Numbers of views, 2 to 8.
        orders: Random orders.
        seed: Of the orders.
        on_scan: Called after every estimated scan, for a progress bar.
    """
    rotations, translations = sequence.camera_from_world[:, :, :3], sequence.camera_from_world[:, :, 3]
    scale = metrics.scene_scale(camera_centre(rotations, translations))
    depths = [n for n in sorted(set(views)) if n <= len(rotations)]
    scans: dict[tuple[str, int], list[_ScanErrors]] = {(m.name, n): [] for m in methods for n in depths}
    for order in view_orders(sequence.name, len(rotations), max(depths, default=0), orders=orders, seed=seed):
        held = [sequence.view(k) for k in order]
        for n in depths:
            true_r, true_t = rotations[order[:n]], translations[order[:n]]
            for method in methods:
                started = time.perf_counter()
                poses = method.poses(held[:n])
                scans[method.name, n].append(
                    _ScanErrors(
                        metrics.rotation_errors(poses.rotations, true_r),
                        metrics.center_errors(poses.rotations, poses.translations, true_r, true_t, scale),
                        metrics.translation_errors(poses.rotations, poses.translations, true_t, scale),
                        time.perf_counter() - started,
                    )
                )
                on_scan()
    return [
        {
            "capture": sequence.name,
            "method": name,
            "views": n,
            "scans": len(group),
            **metrics.summary(
                np.concatenate([scan.rotation for scan in group]),
                np.concatenate([scan.center for scan in group]),
                np.concatenate([scan.translation for scan in group]),
            ),
            "seconds": float(np.mean([scan.seconds for scan in group])),
        }
        for (name, n), group in scans.items()
    ]


def mean_rows(rows: Iterable[Row]) -> list[Row]:
    """Average over captures, each counting the same, for every method and number of views."""
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["method"], row["views"]), []).append(row)
    means = []
    for (method, views), group in groups.items():
        row = {"capture": MEAN, "method": method, "views": views, "scans": sum(r["scans"] for r in group)}
        figures = [key for key in group[0] if key not in row]
        means.append({**row, **{key: float(np.mean([r[key] for r in group])) for key in figures}})
    return means


def table(rows: Sequence[Row], columns: Sequence[str] = SHOWN) -> str:
    """Rows as text for a terminal: fractions in percent, degrees and seconds as they are."""
    heads = ["capture", "method", "N", "scans", *columns]
    lines = [heads]
    for row in rows:
        cells = [str(row["capture"]), str(row["method"]), str(row["views"]), str(row["scans"])]
        for column in columns:
            if column == "seconds":
                cells.append(f"{row[column]:.2f}")
            elif column.endswith("median"):
                cells.append(f"{row[column]:.1f}")
            else:
                cells.append(f"{100 * row[column]:.1f}")
        lines.append(cells)
    widths = [max(len(line[k]) for line in lines) for k in range(len(heads))]
    names, numbers = widths[:2], widths[2:]
    return "\n".join(
        "  ".join(
            [cell.ljust(width) for cell, width in zip(line[:2], names, strict=True)]
            + [cell.rjust(width) for cell, width in zip(line[2:], numbers, strict=True)]
        )
        for line in lines
    )


def evaluate(
    sequences: Sequence[PosedViews],
    views: Sequence[int] = range(MIN_VIEWS, MAX_VIEWS + 1),
    weights: Path | None = None,
    methods: Sequence[str] = METHODS,
    output: Path | None = None,
    seed: int = 0,
    *,
    orders: int = ORDERS,
    threads: int | None = None,
    progress: bool = True,
) -> list[Row]:
    """Measure methods on captures; the rows of each capture, then their mean.

    Args:
        sequences: From `posed_views`, or made of a bag's views.
        views: Numbers of views, each 2 to 8.
        weights: Network file; None for the shipped weights.
        methods: Among `METHODS`.
        output: Where to write ``{"rows": [...]}`` as JSON, or None.
        seed: Of the orders.
        orders: Random orders a capture.
        threads: Of the network; None for torch's own choice.
        progress: Whether to show a progress bar on stderr.

    Raises:
        EvaluationError: No captures, a number of views outside 2 to 8, or an unknown method.
    """
    from tqdm import tqdm

    if not sequences:
        text = "no capture was given; name at least one folder with cameras.json."
        raise EvaluationError(text)
    if not views or min(views) < MIN_VIEWS or max(views) > MAX_VIEWS:
        text = f"numbers of views are {list(views)}; each must lie between {MIN_VIEWS} and {MAX_VIEWS}."
        raise EvaluationError(text)
    chosen = _methods(methods, weights, seed, threads)
    rows: list[Row] = []
    total = orders * len(chosen) * sum(n <= len(s.camera_from_world) for n in set(views) for s in sequences)
    with tqdm(total=total, unit="scan", disable=not progress) as bar:
        for sequence in sequences:
            bar.set_postfix_str(sequence.name)
            rows += measure(sequence, chosen, views, orders=orders, seed=seed, on_scan=bar.update)
    rows += mean_rows(rows)
    if output is not None:
        output.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")
    return rows


def _methods(
    names: Sequence[str], weights: Path | None, seed: int, threads: int | None
) -> list[baselines.Method]:
    if unknown := [name for name in names if name not in METHODS]:
        text = f"{unknown[0]!r} is no method; choose among {', '.join(METHODS)}."
        raise EvaluationError(text)
    chosen: list[baselines.Method] = []
    estimating: dict[str, baselines.Estimated] = {}
    for name in names:
        of = DERIVED.get(name, name)
        if of in EVIDENCE and of not in estimating:
            from relpose_ros.inference.estimator import Estimator

            estimator = Estimator.from_weights(weights, threads, EVIDENCE[of])
            estimating[of] = baselines.Estimated(of, estimator)
        if name in EVIDENCE:
            chosen.append(estimating[name])
        elif name == "constant-translation":
            chosen.append(baselines.ConstantTranslation(estimating[of]))
        elif name == "relpose-known":
            chosen.append(baselines.Known(name, estimating[of]))
        elif name == "identity":
            chosen.append(baselines.Identity())
        elif name == "colmap":
            chosen.append(baselines.Colmap(seed))
    return chosen
