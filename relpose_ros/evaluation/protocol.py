"""The paper's evaluation: seeded orders of a capture's views, each read 2, 3, ... views deep."""

from __future__ import annotations

import json
import time
import zlib
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from relpose_ros.errors import RelPoseError
from relpose_ros.evaluation import baselines, metrics, trust
from relpose_ros.geometry.cameras import camera_centre
from relpose_ros.inference.estimator import Estimator
from relpose_ros.inference.evidence import EvidenceSettings
from relpose_ros.network.presets import variants_of
from relpose_ros.views import MAX_VIEWS, MIN_VIEWS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    import numpy.typing as npt

    from relpose_ros.captures.folder import Capture
    from relpose_ros.views import View

    FloatArray = npt.NDArray[np.float64]

Row = dict[str, Any]
"""One line of the result: capture, method, views, scans, the figures of `metrics.summary`, seconds that a
scan of new views takes; where the method is an estimator, those of `trust.summary` too."""

METHODS = (
    *("relpose", "relpose-known", "both", "learned", "geometry"),
    *("constant-translation", "identity", "pycolmap"),
)
"""relpose is the estimator as it ships: the network, matches and refinement; relpose-known its cameras that
it calls known itself. both leaves out the refinement, learned the matches too; geometry has matches of SIFT
alone, and nothing of the network."""
DERIVED = {"relpose-known": "relpose", "constant-translation": "learned"}
"""Methods that change the answer of another one."""
EVIDENCE = {
    "relpose": EvidenceSettings("refine"),
    "both": EvidenceSettings("pairs"),
    "learned": EvidenceSettings("network"),
    "geometry": EvidenceSettings("pairs", learned=False),
}
"""What the estimator rests on in each of these methods."""
OF_THE_WEIGHTS = {*EVIDENCE, *DERIVED}
"""The methods that ask the network."""
OF_DISTRIBUTIONS = {"relpose", "relpose-known", "both", "geometry"}
"""The methods that a network which regresses poses has not: nothing joins those."""
ORDERS = 5
"""Random orders a capture, as in the paper."""
MEAN = "mean"
"""The ``capture`` of the rows that average over captures."""
SHOWN = {
    "rotation@5": "R@5",
    "rotation@10": "R@10",
    "rotation@15": "R@15",
    "rotation@30": "R@30",
    "rotation@auc60": "R auc",
    "rotation@median": "R median",
    "center@0.1": "C@0.1",
    "center@0.2": "C@0.2",
    "center@0.3": "C@0.3",
    "center@auc0.4": "C auc",
    "translation@0.1": "T@0.1",
    "seconds": "seconds",
}
"""The columns of a table, and their heads: rotation, camera centre, translation."""
SAME_PLACE = 1e-9
"""Of the distance from a world's origin: cameras no further from each other stand at one place."""


class EvaluationError(RelPoseError):
    """Nothing can be measured on what was given."""


@dataclass(frozen=True, eq=False)
class PosedViews:
    """The views of one object, read when asked for, and where their cameras truly stood."""

    name: str
    """Draws the orders of the views, together with a seed."""
    camera_from_world: FloatArray
    """(M, 3, 4), any world and unit."""
    view: Callable[[int], View]
    """The k-th view."""
    place: str = ""
    """Where it is, told in tables where others bear its name."""

    @property
    def label(self) -> str:
        """As it stands in a table."""
        return f"{self.place}: {self.name}" if self.place else self.name

    @classmethod
    def of_views(
        cls, name: str, views: Sequence[View], camera_from_world: Sequence[FloatArray], *, masked: bool = True
    ) -> PosedViews:
        """Views that are held already, as those of a bag are.

        Args:
            name: Of the object.
            views: The M views.
            camera_from_world: M times (3, 4), any world and unit.
            masked: Whether the views keep their masks.

        Raises:
            EvaluationError: There are fewer than two.
        """
        if len(views) < MIN_VIEWS:
            text = f"{name} has {len(views)} views with a pose; measuring needs {MIN_VIEWS} or more."
            raise EvaluationError(text)

        def view(k: int) -> View:
            # A view of its own each time, as of a photo that is read again: estimators keep what they know
            # of a view as long as it lives.
            return replace(views[k]) if masked else replace(views[k], mask=None)

        return cls(name, np.stack(camera_from_world), view)


@dataclass(frozen=True, eq=False)
class _Measured:
    """One scan."""

    rotation: FloatArray
    center: FloatArray
    translation: FloatArray
    statements: trust.Statements | None
    seconds: float


_Scans = dict[tuple[str, int], list[_Measured]]
"""By method and number of views."""


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
        methods: What estimates. Each gets views that it has not seen, but for those of `DERIVED`, which share
            their source's; the time of the source is a part of theirs.
        views: Numbers of views, 2 to 8.
        orders: Random orders.
        seed: Of the orders.
        on_scan: Called after every estimated scan, for a progress bar.
    """
    return _rows(sequence.label, _scans(sequence, methods, views, orders, seed, on_scan))


def _scans(
    sequence: PosedViews,
    methods: Sequence[baselines.Method],
    views: Sequence[int],
    orders: int,
    seed: int,
    on_scan: Callable[[], object],
) -> _Scans:
    rotations, translations = sequence.camera_from_world[:, :, :3], sequence.camera_from_world[:, :, 3]
    scale = metrics.scene_scale(camera_centre(rotations, translations))
    depths = [n for n in sorted(set(views)) if n <= len(rotations)]
    scans: _Scans = {(m.name, n): [] for m in methods for n in depths}
    for order in view_orders(sequence.name, len(rotations), max(depths, default=0), orders=orders, seed=seed):
        held = [sequence.view(k) for k in order]
        for n in depths:
            true_r, true_t = rotations[order[:n]], translations[order[:n]]
            # Estimators keep what they know of a view, and know nothing of another object with its picture.
            fresh: dict[str, list[View]] = {}
            seconds: dict[str, float] = {}
            for method in methods:
                source = DERIVED.get(method.name, method.name)
                given = fresh.setdefault(source, [replace(view) for view in held[:n]])
                started = time.perf_counter()
                poses = method.poses(given)
                seconds[source] = seconds.get(source, 0.0) + time.perf_counter() - started
                estimate = poses.estimate
                scans[method.name, n].append(
                    _Measured(
                        metrics.rotation_errors(poses.rotations, true_r),
                        metrics.center_errors(poses.rotations, poses.translations, true_r, true_t, scale),
                        metrics.translation_errors(poses.rotations, poses.translations, true_t, scale),
                        None if estimate is None else trust.statements(estimate, given, true_r, true_t),
                        seconds[source],
                    )
                )
                on_scan()
    return scans


def _rows(capture: str, scans: _Scans) -> list[Row]:
    return [
        {
            "capture": capture,
            "method": name,
            "views": n,
            "scans": len(group),
            **metrics.summary(
                np.concatenate([scan.rotation for scan in group]),
                np.concatenate([scan.center for scan in group]),
                np.concatenate([scan.translation for scan in group]),
            ),
            "seconds": float(np.mean([scan.seconds for scan in group])),
            **_trust(group),
        }
        for (name, n), group in scans.items()
    ]


def _trust(group: Sequence[_Measured]) -> dict[str, float]:
    said = [scan.statements for scan in group if scan.statements is not None]
    return trust.summary(said) if said else {}


def mean_rows(rows: Iterable[Row]) -> list[Row]:
    """Average over captures, each counting the same, for every method and number of views."""
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["method"], row["views"]), []).append(row)
    means = []
    for (method, views), group in groups.items():
        row = {"capture": MEAN, "method": method, "views": views, "scans": sum(r["scans"] for r in group)}
        figures = [key for key in group[0] if key not in row and all(key in each for each in group)]
        means.append({**row, **{key: float(np.mean([r[key] for r in group])) for key in figures}})
    return means


def table(rows: Sequence[Row], columns: Mapping[str, str] = SHOWN) -> str:
    """Rows as text for a terminal: fractions in percent, degrees and seconds as they are.

    Args:
        rows: Of one or more captures.
        columns: Figures, and the heads above them; a figure that a row has not is left blank.
    """
    heads = ["capture", "method", "N", "scans", *columns.values()]
    lines = [heads]
    for row in rows:
        cells = [str(row["capture"]), str(row["method"]), str(row["views"]), str(row["scans"])]
        for column in columns:
            if column not in row:
                cells.append("")
            elif column == "seconds":
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


def trust_table(rows: Sequence[Row]) -> str:
    """As `table`: how far what estimators say of their own errors holds; empty without estimators."""
    estimated = [row for row in rows if row["capture"] == MEAN and "enough" in row]
    return table(estimated, trust.SHOWN) if estimated else ""


def evaluate(
    sequences: Sequence[PosedViews],
    views: Sequence[int] = range(MIN_VIEWS, MAX_VIEWS + 1),
    weights: Path | None = None,
    methods: Sequence[str] | None = None,
    output: Path | None = None,
    seed: int = 0,
    *,
    variants: Sequence[Path] = (),
    orders: int = ORDERS,
    threads: int | None = None,
    progress: bool = True,
) -> list[Row]:
    """Measure methods on captures; the rows of each capture, then their mean.

    In the mean every capture counts the same; but what estimates say of their errors is held against all
    scans together, since few of them say little of a probability.

    Args:
        sequences: From `posed_views`, or made of a bag's views.
        views: Numbers of views, each 2 to 8.
        weights: Network file; None for the shipped weights.
        methods: Among `METHODS`; None for all that these weights have.
        output: Where to write ``{"rows": [...]}`` as JSON, after each capture, or None.
        seed: Of the orders.
        variants: Network files of variants of the paper, each measured alone in rows that bear its name.
        orders: Random orders a capture.
        threads: Of the network; None for torch's own choice.
        progress: Whether to show a progress bar on stderr.

    Raises:
        EvaluationError: No captures, two of one name, none of as many views or one whose cameras stand at one
            place, a number of views outside 2 to 8, of orders below 1 or a seed below 0, a method that there
            is not (with these weights), a file that holds no variant or one that was named before, or an
            output that cannot be written.
        NetworkFileError: Weights cannot be loaded.
    """
    from tqdm import tqdm

    if not sequences:
        text = "no capture was given; name at least one folder with cameras.json."
        raise EvaluationError(text)
    if not views or min(views) < MIN_VIEWS or max(views) > MAX_VIEWS:
        text = f"numbers of views are {list(views)}; each must lie between {MIN_VIEWS} and {MAX_VIEWS}."
        raise EvaluationError(text)
    if orders < 1 or seed < 0:
        raise EvaluationError(
            f"{orders} orders by the seed {seed} are none; ask for 1 or more, by 0 or more."
        )
    _require_measurable(sequences, min(views))
    chosen = _methods(methods, weights, seed, threads) + _variants(variants, threads)
    rows: list[Row] = []
    everywhere: _Scans = {}
    total = orders * len(chosen) * sum(n <= len(s.camera_from_world) for n in set(views) for s in sequences)
    with tqdm(total=total, unit="scan", disable=not progress) as bar:
        for sequence in sequences:
            # Before the first capture, to know that it can be; then for who interrupts it.
            _write(rows, output)
            bar.set_postfix_str(sequence.label)
            scans = _scans(sequence, chosen, views, orders, seed, bar.update)
            rows += _rows(sequence.label, scans)
            for key, group in scans.items():
                everywhere.setdefault(key, []).extend(group)
    rows += [{**row, **_trust(everywhere[row["method"], row["views"]])} for row in mean_rows(rows)]
    _write(rows, output)
    return rows


def _require_measurable(sequences: Sequence[PosedViews], least: int) -> None:
    name, times = Counter(sequence.label for sequence in sequences).most_common(1)[0]
    if times > 1:
        raise EvaluationError(f"two captures are called {name}; rename one, or name it once.")
    most = max(len(sequence.camera_from_world) for sequence in sequences)
    if most < least:
        raise EvaluationError(f"no capture has {least} views with a pose, the most have {most}.")
    for each in sequences:
        centres = camera_centre(each.camera_from_world[:, :, :3], each.camera_from_world[:, :, 3])
        if not metrics.scene_scale(centres) > SAME_PLACE * np.abs(centres).max():
            text = f"{each.label} has all its cameras at one place; distances there mean nothing."
            raise EvaluationError(text)


def _write(rows: Sequence[Row], output: Path | None) -> None:
    if output is None:
        return
    try:
        output.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")
    except OSError as err:
        text = f"{output} cannot be written: {err.strerror}; name another file for the rows."
        raise EvaluationError(text) from err


def _methods(
    names: Sequence[str] | None, weights: Path | None, seed: int, threads: int | None
) -> list[baselines.Method]:
    if unknown := [name for name in names or () if name not in METHODS]:
        text = f"{unknown[0]!r} is no method; choose among {', '.join(METHODS)}."
        raise EvaluationError(text)
    estimating: dict[str, baselines.Estimated] = {}
    if names is None or OF_THE_WEIGHTS.intersection(names):
        estimator = Estimator.from_weights(weights, threads)
        estimating = {
            name: baselines.Estimated(name, estimator.with_evidence(evidence))
            for name, evidence in EVIDENCE.items()
        }
        without = OF_DISTRIBUTIONS if estimator.preset.rotation == "regression" else set()
        if amiss := without.intersection(names or ()):
            text = f"{weights} regresses poses, which nothing joins: measure 'learned', not {min(amiss)!r}."
            raise EvaluationError(text)
        if names is None:
            names = [name for name in METHODS if name not in without]
    chosen: list[baselines.Method] = []
    for name in names or ():
        of = DERIVED.get(name, name)
        if name in EVIDENCE:
            chosen.append(estimating[name])
        elif name == "constant-translation":
            chosen.append(baselines.ConstantTranslation(estimating[of]))
        elif name == "relpose-known":
            chosen.append(baselines.Known(name, estimating[of]))
        elif name == "identity":
            chosen.append(baselines.Identity())
        elif name == "pycolmap":
            chosen.append(baselines.Colmap(seed))
    return chosen


def _variants(files: Sequence[Path], threads: int | None) -> list[baselines.Method]:
    chosen: dict[str, baselines.Method] = {}
    for file in files:
        estimator = Estimator.from_weights(file, threads, EVIDENCE["learned"])
        name = "+".join(variants_of(estimator.preset))
        if not name:
            of = estimator.preset.name
            text = f"{file} holds the network {of!r} and no variant of it: name it as weights."
            raise EvaluationError(text)
        if name in chosen:
            raise EvaluationError(f"{file} holds another {name}; of each variant one file can be measured.")
        chosen[name] = baselines.Estimated(name, estimator)
    return list(chosen.values())
