"""A bag through the node's own scanner, message by message in log order; the same files at every run."""

from __future__ import annotations

import json
import logging
import re
import shutil
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from relpose_ros.errors import RelPoseError
from relpose_ros.estimates import Evidence
from relpose_ros.geometry import so3
from relpose_ros.replay.bags import BagReader, BagWriter, choose_inputs
from relpose_ros.replay.ground_truth import of_one_camera, read_true_poses
from relpose_ros.replay.recording import Recording
from relpose_ros.replay.report import Cells, write_report
from relpose_ros.scanning.outgoing import estimate_message, markers, pose_array
from relpose_ros.scanning.scanner import Scanner
from relpose_ros.scanning.settings import ScanSettings

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from relpose_ros.estimates import CameraPose, FloatArray, Mode, ObjectPose, PairRotation
    from relpose_ros.replay.bags import Input
    from relpose_ros.replay.comparison import TruePose
    from relpose_ros.replay.recording import EstimateRecord, ViewRecord
    from relpose_ros.scanning.scanner import SupportsEstimate
    from relpose_ros.views import Scan

logger = logging.getLogger("relpose_ros")

ESTIMATE_TOPIC = "/scan_node/estimate"
POSES_TOPIC = "/scan_node/poses"
MARKERS_TOPIC = "/scan_node/markers"
"""The node's own names, so that a layout made for the node shows a replay too."""

ESTIMATES_FOLDER, SCAN_FILE, REPORT_FILE = "estimates", "scan.json", "report.html"
SHOWN_REASONS = 6
"""Kinds of rejected messages that are told apart at the end."""
WAITED = (
    "and frame_id before the bag ended or more later pictures came than pairing_queue lets wait: record both "
    "with one stamp and frame_id, or raise that parameter"
)


class ShowsDistributions(Protocol):
    """What a report asks of an estimator that can give more than modes."""

    def pair_masses(self, scan: Scan) -> Sequence[tuple[FloatArray, FloatArray]]:
        """Of each pair, in the estimate's order: (L, 3, 3) rotations and the (L,) probability of each."""


class ReplayError(RelPoseError):
    """A bag gave no estimate, or its output cannot be written where it was asked for."""


def replay(
    bag: Path,
    output: Path,
    *,
    topics: Sequence[str] = (),
    settings: ScanSettings | None = None,
    weights: Path | None = None,
    estimator: SupportsEstimate | None = None,
) -> None:
    """Estimate from a recorded bag what the node would have estimated, and write it down.

    Writes ``output/estimates`` (a bag of ScanEstimate, PoseArray and MarkerArray, logged when their newest
    view was), ``output/scan.json`` and ``output/report.html``; with several objects in the bag each has
    a folder of its own in ``output``. The bag and the JSON are the same to the byte at every run.

    Args:
        bag: A rosbag2 folder, or a single .mcap or .db3 file.
        output: Created; an earlier replay's output there is replaced, anything else is left alone.
        topics: Topics of images or views; none: what the bag has, see ``choose_inputs``.
        settings: Of the scanner; None for the defaults.
        weights: A weights file; None for the settings' own, which are the shipped ones by default.
        estimator: Makes the estimates; None for the learned one with ``weights``.

    Raises:
        BagError: The bag cannot be read or has no images.
        ReplayError: No estimate came of it, or the output is in the way.
        NetworkFileError: The weights cannot be loaded.
    """
    bag, output = Path(bag), Path(output)
    settings = settings or ScanSettings()
    _check_replaceable(output)
    with BagReader(bag) as reader:
        inputs = choose_inputs(reader, topics)
        truth = read_true_poses(reader)
        _check_writable(output)  # before the long part
        if estimator is None:
            estimator = settings.load_estimator(weights)
        scanner, rejections = Scanner(estimator, settings), _Rejections()
        recordings = _fed(reader, inputs, scanner, rejections, settings)
    _warn_of_lone_poses(inputs, scanner)
    rejected = rejections.most_common()
    for topic, count in sorted(reader.unreadable.items()):
        rejected.append((f"{topic}: the message is not what its type says.", count))
    if recordings and (alone := _images_alone(scanner)):
        rejected.append((f"A picture found no camera info of its stamp {WAITED}.", alone))
    for example, count in rejected[:SHOWN_REASONS]:
        logger.warning("%d rejected: %s", count, example)
    if len(rejected) > SHOWN_REASONS:
        more = sum(count for _, count in rejected[SHOWN_REASONS:])
        logger.warning("%d more rejected for %d further reasons.", more, len(rejected) - SHOWN_REASONS)
    if not recordings:
        raise ReplayError(_why_nothing(bag, scanner, rejected))
    with _written_whole(output) as folder:
        for name, recording in _folders(recordings).items():
            cells = _cells(estimator, recording)
            known = of_one_camera(truth, (each.view.stamp_ns for each in recording.views))
            _write(folder / name, recording, settings, known, rejected, bag.name, cells)
    for name, recording in _folders(recordings).items():
        _tell(output / name / REPORT_FILE, recording)


class _Rejections:
    """What was rejected, by reason: the numbers in it differ from message to message, the reason does not."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._examples: dict[str, str] = {}

    def add(self, reason: str) -> None:
        general = re.sub(r"-?\d[\d.e+-]*", "#", reason)
        self._counts[general] += 1
        self._examples.setdefault(general, reason)

    def most_common(self) -> list[tuple[str, int]]:
        """An example of each, and how many there are of its kind."""
        return [(self._examples[general], count) for general, count in self._counts.most_common()]


def _fed(
    reader: BagReader,
    inputs: Mapping[str, Input],
    scanner: Scanner,
    rejections: _Rejections,
    settings: ScanSettings,
) -> dict[str, Recording]:
    """A bag's messages through a scanner, with a progress bar: what came of it, by object."""
    recordings: dict[str, Recording] = {}
    forgotten: set[str] = set()
    total = sum(reader.counts[topic] for topic in inputs)
    name = reader.path.name
    with logging_redirect_tqdm(), tqdm(total=total, desc=name, unit=" msg", disable=None) as progress:
        for record in reader.records(inputs):
            entry = inputs[record.topic]
            receipt = scanner.receive(entry.kind, record.topic, record.message, entry.camera)
            if receipt.rejected:
                rejections.add(receipt.reason)
            while scanner.pending():
                for result in scanner.estimate_pending():
                    object_id = result.scan.object_id
                    if not result.estimate.cameras:  # takes back what a file keeps
                        forgotten.add(object_id)
                        continue
                    recording = recordings.setdefault(object_id, Recording(object_id, keep=settings.keep))
                    recording.add(result, record.log_time_ns)
                    progress.set_postfix_str(result.estimate.status[:60], refresh=False)
            progress.update()
    scans = scanner.statistics().scans
    # The counts of a scan that made room for another object's are gone with it.
    for object_id in recordings.keys() - forgotten:
        recordings[object_id].declined = scans[object_id].declined
    return recordings


def _warn_of_lone_poses(inputs: Mapping[str, Input], scanner: Scanner) -> None:
    topics = scanner.statistics().topics
    for topic, entry in inputs.items():
        if entry.kind == "camera_pose" and topic in topics and not topics[topic].used:
            text = (
                "None of the %d camera poses on %s has the stamp of a view: they tell nothing of the scale."
            )
            logger.warning(text, topics[topic].received, topic)


def _tell(report: Path, recording: Recording) -> None:
    """In the log, what came of one object's views."""
    last = recording.estimates[-1].estimate
    logger.info(
        "%s: %d estimates of %r from %d views, %.2f s each; %s.",
        *(report, len(recording.estimates), recording.object_id),
        *(len(recording.views), np.mean([each.estimate.seconds for each in recording.estimates])),
        last.status,
    )
    told = [recording.arrivals() if recording.declined else "", recording.lost_enough()]
    if any(told):
        logger.info("Of %r: %s.", recording.object_id, "; ".join(filter(None, told)))


def _cells(
    estimator: SupportsEstimate | ShowsDistributions, recording: Recording
) -> dict[tuple[int, int], Cells]:
    """The distributions behind the last estimate, where the estimator shows them."""
    if not hasattr(estimator, "pair_masses") or recording.newest_scan is None:
        return {}
    pairs = recording.estimates[-1].estimate.pairs
    masses = estimator.pair_masses(recording.newest_scan)
    return {(pair.i, pair.j): Cells(*each) for pair, each in zip(pairs, masses, strict=True)}


def _why_nothing(bag: Path, scanner: Scanner, rejected: Sequence[tuple[str, int]]) -> str:
    statistics = scanner.statistics()
    held = sum(scan.views for scan in statistics.scans.values())
    if statistics.failed:
        return f"{bag} gave no estimate: {statistics.last_failure}"
    reasons = f"; {rejected[0][1]} messages were rejected, such as: {rejected[0][0]}" if rejected else "."
    if not held and not rejected and (alone := _images_alone(scanner)):
        return f"{bag} gave no estimate: {alone} pictures came, and no camera info of their stamps {WAITED}."
    count = {0: "no view", 1: "one view"}.get(held, f"{held} views")
    return f"{bag} gave no estimate: {count} could be used, and an estimate takes two of one object{reasons}"


def _images_alone(scanner: Scanner) -> int:
    """Images that found no camera info of their stamp."""
    statistics = scanner.statistics()
    return statistics.images_alone + statistics.waiting


def _folders(recordings: Mapping[str, Recording]) -> dict[str, Recording]:
    """Where each object's output goes: nowhere deeper for a single one, else folders named after them."""
    if len(recordings) == 1:
        return {".": next(iter(recordings.values()))}
    folders: dict[str, Recording] = {}
    for object_id, recording in recordings.items():
        safe = re.sub(r"[^\w.-]", "_", object_id, flags=re.ASCII).strip(".")[:80] or "object"
        name, number = safe, 2
        # Some file systems do not tell Mug from mug.
        while name.lower() in {taken.lower() for taken in folders}:
            name, number = f"{safe}-{number}", number + 1
        folders[name] = recording
    return folders


def _write(
    folder: Path,
    recording: Recording,
    settings: ScanSettings,
    truth: Mapping[int, TruePose],
    rejected: Sequence[tuple[str, int]],
    title: str,
    cells: Mapping[tuple[int, int], Cells],
) -> None:
    folder.mkdir(exist_ok=True)
    _write_bag(folder / ESTIMATES_FOLDER, recording, settings.object_frame)
    (folder / SCAN_FILE).write_text(scan_json(recording), encoding="utf-8")
    write_report(folder / REPORT_FILE, recording, truth, rejected, title, cells)


def _write_bag(path: Path, recording: Recording, object_frame: str) -> None:
    with BagWriter(path) as bag:
        bag.add_topic(ESTIMATE_TOPIC, "relpose_ros/msg/ScanEstimate", latched=True)
        bag.add_topic(POSES_TOPIC, "geometry_msgs/msg/PoseArray", latched=True)
        bag.add_topic(MARKERS_TOPIC, "visualization_msgs/msg/MarkerArray", latched=True)
        for each in recording.estimates:
            scan, estimate, log_time = each.scan, each.estimate, each.log_time_ns
            message = estimate_message(estimate, scan, bag.types, object_frame, timed=False)
            bag.write(ESTIMATE_TOPIC, log_time, message)
            bag.write(POSES_TOPIC, log_time, pose_array(estimate, scan, bag.types, object_frame))
            bag.write(MARKERS_TOPIC, log_time, markers(estimate, scan, bag.types, object_frame))


def scan_json(recording: Recording) -> str:
    """The recording as JSON.

    ``views`` of an estimate are positions in the top-level ``views``; ``view``, ``i`` and ``j`` below it are
    positions in the estimate's own ``views``, as in the messages, and ``weakest_pair`` one in its ``pairs``.
    Matrices are flat and row-major, with the units and frames of the messages; boxes are [left, top, right,
    bottom] in pixels of the full image, (0, 0) being the outer corner of its first pixel.
    """
    views = [_view_json(index, view) for index, view in enumerate(recording.views)]
    estimates = [_estimate_json(each) for each in recording.estimates]
    # One view and one estimate a line: small, and a difference between two runs shows where it is.
    return (
        f'{{"object_id": {_json(recording.object_id)},\n"views": [\n{_lines(views)}\n],\n'
        f'"estimates": [\n{_lines(estimates)}\n]}}\n'
    )


def _view_json(index: int, record: ViewRecord) -> dict[str, Any]:
    view = record.view
    return {
        "index": index,
        "stamp_ns": view.stamp_ns,
        "frame_id": view.frame_id,
        "box": [float(edge) for edge in (view.box.x0, view.box.y0, view.box.x1, view.box.y1)],
    }


def _estimate_json(record: EstimateRecord) -> dict[str, Any]:
    estimate = record.estimate
    return {
        "views": list(record.views),
        "verdict": estimate.verdict.name,
        "calibrated": bool(estimate.calibrated),
        "weakest_pair": int(estimate.weakest_pair),
        "score": float(estimate.score),
        "scale_known": bool(estimate.scale_known),
        "scale_deviation": float(estimate.scale_deviation),
        "object_pose": None if estimate.object_pose is None else _object_pose_json(estimate.object_pose),
        "status": estimate.status,
        "cameras": [_camera_json(camera) for camera in estimate.cameras],
        "pairs": [_pair_json(pair) for pair in estimate.pairs],
    }


def _object_pose_json(pose: ObjectPose) -> dict[str, Any]:
    return {
        "frame_id": pose.frame_id,
        "position": _numbers(pose.position),
        "orientation_xyzw": _numbers(so3.quaternion_xyzw(pose.robot_from_object)),
        "covariance": _numbers(pose.covariance),
    }


def _camera_json(camera: CameraPose) -> dict[str, Any]:
    return {
        "view": int(camera.view),
        "position": _numbers(camera.position),
        "orientation_xyzw": _numbers(so3.quaternion_xyzw(camera.object_from_camera)),
        "covariance": _numbers(camera.covariance),
    }


def _pair_json(pair: PairRotation) -> dict[str, Any]:
    return {
        "i": int(pair.i),
        "j": int(pair.j),
        "orientation_xyzw": _numbers(so3.quaternion_xyzw(pair.camera_j_from_camera_i)),
        "covariance": _numbers(pair.covariance),
        "probability_within_15_deg": float(pair.probability_within_15_deg),
        "entropy": float(pair.entropy),
        "ambiguous": bool(pair.ambiguous),
        "ambiguity_angle": float(pair.ambiguity_angle),
        "solution_probability": float(pair.solution_probability),
        "solution_angle": float(pair.solution_angle),
        "evidence": [each.name for each in Evidence if each in pair.evidence],
        "modes": [_mode_json(mode) for mode in pair.modes],
    }


def _mode_json(mode: Mode) -> dict[str, Any]:
    return {
        "orientation_xyzw": _numbers(so3.quaternion_xyzw(mode.camera_j_from_camera_i)),
        "weight": float(mode.weight),
        "covariance": _numbers(mode.covariance),
    }


def _numbers(array: np.typing.ArrayLike) -> list[float]:
    return [float(value) for value in np.asarray(array, np.float64).reshape(-1)]


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


def _lines(values: Sequence[Any]) -> str:
    return ",\n".join(_json(value) for value in values)


def _check_replaceable(output: Path) -> None:
    """Refuse an output that holds anything but an earlier replay's files."""
    if output.name in ("", ".."):
        raise ReplayError(f"{output} cannot be replaced as a whole; name a folder for the output.")
    if not output.exists():
        return
    if not output.is_dir():
        raise ReplayError(f"{output} is a file; name a folder for the output.")
    foreign = _foreign(output)
    if foreign is not None:
        text = f"{output} holds {foreign}, which no replay wrote; name another folder or move it away."
        raise ReplayError(text)


def _check_writable(output: Path) -> None:
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=output.parent):
            pass
    except OSError as err:
        text = f"{output} cannot be written: {err.strerror}; name another folder for the output."
        raise ReplayError(text) from err


def _foreign(folder: Path, depth: int = 0) -> str | None:
    """The first entry of a folder that is none of a replay's."""
    for entry in sorted(folder.iterdir()):
        if entry.is_file() and entry.name in (SCAN_FILE, REPORT_FILE):
            continue
        if entry.is_dir() and not entry.is_symlink():
            if entry.name == ESTIMATES_FOLDER and (folder / SCAN_FILE).is_file():
                continue
            if depth == 0 and (entry / SCAN_FILE).is_file() and _foreign(entry, depth + 1) is None:
                continue
        return entry.name
    return None


@contextmanager
def _written_whole(output: Path) -> Iterator[Path]:
    """A folder that takes the output's place when it is complete: a replay that fails leaves the old one."""
    with TemporaryDirectory(dir=output.parent, prefix=f".{output.name}-") as temporary:
        folder = Path(temporary) / "new"
        folder.mkdir()
        yield folder
        if output.exists():
            output.rename(Path(temporary) / "old")
        shutil.move(folder, output)
