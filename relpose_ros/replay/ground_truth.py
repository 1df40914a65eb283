"""True camera poses in a bag: for the report of a replay, and for measuring on its views."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import translation_of
from relpose_ros.replay.bags import POSE_STAMPED, BagError, BagReader, choose_inputs
from relpose_ros.replay.comparison import TruePose
from relpose_ros.scanning.incoming import (
    QUATERNION_TOLERANCE,
    ViewError,
    object_id_of,
    source_of,
    view_from_image,
    view_from_object_view,
)
from relpose_ros.scanning.pairing import Arrival, Pairing
from relpose_ros.scanning.settings import ScanSettings

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from relpose_ros.estimates import FloatArray
    from relpose_ros.replay.bags import Input, Record
    from relpose_ros.views import View

logger = logging.getLogger("relpose_ros")

GROUND_TRUTH_TOPIC = "ground_truth/pose"


@dataclass(frozen=True, eq=False)
class PosedView:
    """A view, and where its camera truly stood."""

    view: View
    camera_from_world: FloatArray
    """(3, 4), world frame and unit of the bag's own."""


def read_posed_views(path: Path, topics: Sequence[str] = ()) -> dict[str, list[PosedView]]:
    """All views of a bag whose true pose is known, of each object in log order.

    Messages become views as in the node; what it would reject is left out, with a line in the log. But
    nothing is let go: all views of a long recording are held.

    Args:
        path: A rosbag2 folder, or a single .mcap or .db3 file.
        topics: Topics of images or views; none: what the bag has, see ``choose_inputs``.

    Raises:
        BagError: The bag cannot be read, has no images, no true poses, or none of the images' stamps.
    """
    with BagReader(path) as reader:
        inputs = choose_inputs(reader, topics)
        truth = read_true_poses(reader)
        if not truth:
            text = f"{path} holds no true poses: record them as PoseStamped on {GROUND_TRUTH_TOPIC}."
            raise BagError(text)
        views: dict[str, dict[tuple[int, str], View]] = {}
        for object_id, view in _views(reader.records(inputs), inputs):
            views.setdefault(object_id, {}).setdefault((view.stamp_ns, view.frame_id), view)
    posed = {}
    for object_id, of_object in views.items():
        known = of_one_camera(truth, (view.stamp_ns for view in of_object.values()))
        chosen = [
            PosedView(view, _camera_from_world(known[view.stamp_ns]))
            for view in of_object.values()
            if view.stamp_ns in known
        ]
        if chosen:
            posed[object_id] = chosen
    if not posed:
        raise BagError(f"{path} holds {len(truth)} true poses, but none with the stamp of a view.")
    return posed


def read_true_poses(reader: BagReader) -> dict[int, TruePose]:
    """True camera poses by stamp, from every PoseStamped topic called ground_truth/pose.

    Stamps with two poses, of cameras that are triggered together, are left out: a pose names no camera.
    """
    topics = [
        topic
        for topic, kind in reader.topics.items()
        if kind == POSE_STAMPED and f"/{topic}".endswith(f"/{GROUND_TRUTH_TOPIC}")
    ]
    truth: dict[int, TruePose] = {}
    shared: set[int] = set()
    for record in reader.records(topics):
        stamp, pose = record.message.header.stamp, record.message.pose
        q, p = pose.orientation, pose.position
        quaternion, centre = np.array([q.x, q.y, q.z, q.w]), np.array([p.x, p.y, p.z])
        stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        unit = abs(np.linalg.norm(quaternion) - 1) < QUATERNION_TOLERANCE
        if not (np.isfinite(centre).all() and unit):
            logger.warning(
                "The true pose on %s with stamp %d ns is no pose; it is left out.", record.topic, stamp_ns
            )
            continue
        pose = TruePose(so3.from_quaternion_xyzw(quaternion), centre)
        if not _same(truth.setdefault(stamp_ns, pose), pose):
            shared.add(stamp_ns)
    if shared:
        logger.warning("%d stamps have several true poses; those are left out.", len(shared))
    return {stamp_ns: pose for stamp_ns, pose in truth.items() if stamp_ns not in shared}


def of_one_camera(truth: Mapping[int, TruePose], stamps_ns: Iterable[int]) -> dict[int, TruePose]:
    """The true poses, without those whose stamp several of an object's views have: it is one camera's."""
    views = Counter(stamps_ns)
    return {stamp_ns: pose for stamp_ns, pose in truth.items() if views[stamp_ns] <= 1}


def _same(one: TruePose, other: TruePose) -> bool:
    turns = np.array_equal(one.world_from_camera, other.world_from_camera)
    return turns and np.array_equal(one.centre, other.centre)


def _camera_from_world(pose: TruePose) -> FloatArray:
    rotation = pose.world_from_camera.T
    return np.column_stack([rotation, translation_of(rotation, pose.centre)])


def _views(records: Iterable[Record], inputs: Mapping[str, Input]) -> Iterator[tuple[str, View]]:
    """Every view that messages give, with its object's id."""
    settings = ScanSettings()
    pairing = Pairing(settings.pairing_queue, round(settings.backward_jump_s * 1e9))
    for record in records:
        entry = inputs[record.topic]
        try:
            source = source_of(record.message, record.topic)
            if entry.kind == "object_view":
                object_id = object_id_of(record.message, source, settings.object_id)
                yield object_id, view_from_object_view(record.message, source)
                continue
            for pair in pairing.add(entry.kind, Arrival(record.message, source), entry.camera):
                image, info = pair.image, pair.info
                view = view_from_image(image.message, info.message, image.source, settings.rectification)
                yield settings.object_id, view
        except ViewError as err:
            logger.warning("Left out: %s", err)
