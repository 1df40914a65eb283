"""Tiny bags with known poses, and an estimator whose answers are known beforehand."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import pytest

from relpose_ros.captures.folder import Frame, save_capture
from relpose_ros.estimates import CameraPose, Evidence, Mode, PairRotation, ScanEstimate, Verdict
from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import look_at, translation_of
from relpose_ros.replay.bags import BagReader, BagWriter
from relpose_ros.replay.comparison import TruePose
from relpose_ros.views import BoundingBox, Intrinsics, Scan, View

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from relpose_ros.replay.bags import Record

SIDE = 48


def ring_of_cameras(count: int) -> list[TruePose]:
    """Cameras on a tilted ring of radius 2 that look at (0.3, 0.2, 0.1)."""
    target = np.array([0.3, 0.2, 0.1])
    poses = []
    for k in range(count):
        turn = 0.6 * k
        centre = target + 2 * np.array([np.cos(turn), np.sin(turn), 0.4 + 0.1 * (k % 3)])
        poses.append(TruePose(look_at(centre, target).T, centre))
    return poses


def write_capture(folder: Path, count: int, *, posed: bool = True) -> list[TruePose]:
    """A capture of ``count`` photos: flat colours, each its own, with a box and a mask."""
    poses = ring_of_cameras(count)
    frames = []
    for k, pose in enumerate(poses):
        image = np.full((SIDE, SIDE + 16, 3), (20 * k + 20, 128, 200 - 20 * k), np.uint8)
        mask = np.zeros(image.shape[:2], bool)
        mask[12:36, 16:40] = True
        view = View(
            image, BoundingBox(14, 10, 42, 38), SIDE + 16, SIDE,
            intrinsics=Intrinsics(60, 60, 32, 24) if posed else None, mask=mask,
        )  # fmt: skip
        rotation = pose.world_from_camera.T
        camera_from_world = np.hstack([rotation, translation_of(rotation, pose.centre)[:, None]])
        frames.append(Frame(view, camera_from_world if posed else None))
    save_capture(folder, frames)
    return poses


@dataclass
class FakeEstimator:
    """Tells the truth, turned by ``error_deg`` about the optical axis of every camera but the first.

    Views are recognised by their stamps, as `pack` gives them: one second apart, from one second on.
    """

    truth: list[TruePose]
    error_deg: float = 0.0
    scans: list[Scan] = field(default_factory=list)

    def estimate(self, scan: Scan) -> ScanEstimate:
        self.scans.append(scan)
        true = [self.truth[round(view.stamp_ns / 1e9) - 1] for view in scan.views]
        first = true[0]
        turn = so3.exp([0, 0, np.radians(self.error_deg)])
        rotations = [
            first.world_from_camera.T @ pose.world_from_camera @ (turn if k else np.eye(3))
            for k, pose in enumerate(true)
        ]
        centres = [first.world_from_camera.T @ (pose.centre - [0.3, 0.2, 0.1]) / 2 for pose in true]
        cameras = tuple(
            CameraPose(k, rotations[k], centres[k], np.eye(6) * 1e-4 * (k + 1)) for k in range(len(true))
        )
        pairs = tuple(
            self._pair(i, j, rotations[j].T @ rotations[i], ambiguous=(i, j) == (0, 1))
            for i in range(len(true))
            for j in range(i + 1, len(true))
        )
        enough = len(true) > 2
        return ScanEstimate(
            object_id=scan.object_id, cameras=cameras, pairs=pairs, score=1.0, scale_known=False,
            calibrated=False, verdict=Verdict.ENOUGH if enough else Verdict.ONE_MORE_VIEW, weakest_pair=0,
            status="enough" if enough else "one more view: pair 0-1 is ambiguous by about 180 degrees",
            seconds=0.01 * np.random.default_rng().random(),
        )  # fmt: skip

    def _pair(self, i: int, j: int, rotation: np.ndarray, *, ambiguous: bool) -> PairRotation:
        covariance = np.eye(3) * 0.01
        modes = [Mode(rotation, 0.55 if ambiguous else 0.9, covariance)]
        if ambiguous:
            modes.append(Mode(so3.exp([0, np.pi, 0]) @ rotation, 0.4, covariance))
        return PairRotation(
            i, j, rotation, covariance, -3.0, modes[0].weight, tuple(modes), ambiguous,
            np.pi if ambiguous else 0.0, modes[0].weight, 0.01,
            Evidence.LEARNED if ambiguous else Evidence.LEARNED | Evidence.GEOMETRIC,
        )  # fmt: skip


@pytest.fixture
def fake_estimator() -> type[FakeEstimator]:
    """The class: test modules cannot import this one."""
    return FakeEstimator


@pytest.fixture
def write_posed_capture() -> Callable[..., list[TruePose]]:
    return write_capture


@pytest.fixture
def capture(tmp_path: Path) -> tuple[Path, list[TruePose]]:
    return tmp_path / "cup", write_capture(tmp_path / "cup", 5)


@pytest.fixture
def rewrite() -> Callable[[Path, Path, Callable[[Record], Iterable[Record]]], Path]:
    """Writes a copy of a bag with each message changed, left out or repeated, and returns its path."""

    def written(source: Path, target: Path, change: Callable[[Record], Iterable[Record]]) -> Path:
        with BagReader(source) as bag, BagWriter(target) as writer:
            changed = [new for record in bag.records(bag.topics) for new in change(record)]
            for record in {record.topic: record for record in changed}.values():
                writer.add_topic(record.topic, record.message.__msgtype__)
            for record in changed:
                writer.write(record.topic, record.log_time_ns, record.message)
        return target

    return written
