"""What the node says to a person: log lines, advice about QoS, and the diagnostics."""

from __future__ import annotations

import logging
import re
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.qos import QoSPolicyKind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from relpose_ros.scanning.scanner import Statistics

AGAINST_LOSS = "Make the publishers reliable, raise net.core.rmem_max, or send compressed images."
REPEAT_AFTER_S = 5.0
"""A rejection like one that was just logged is counted, and told again after this long."""


class LogForwarder(logging.Handler):
    """Takes the records of a standard logger to a ROS logger, which knows the level the user asked for."""

    def __init__(self, ros_logger: Any) -> None:
        super().__init__()
        self._ros = ros_logger
        self._throttle = Throttle()
        self.setFormatter(logging.Formatter("%(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        """Log one record. A line of its own for each severity: rclpy refuses a call site that changes it."""
        text = self.format(record)
        if record.levelno >= logging.WARNING:
            line = self._throttle.pass_on(record.levelname, text)
            if line is None:
                return
            text = line
        if record.levelno >= logging.ERROR:
            self._ros.error(text)
        elif record.levelno >= logging.WARNING:
            self._ros.warning(text)
        elif record.levelno >= logging.INFO:
            self._ros.info(text)
        else:
            self._ros.debug(text)


class Throttle:
    """Lets the first message of a kind pass at once, and later ones every few seconds with a count.

    Two sentences are of a kind when they differ in figures and quoted values alone.
    """

    def __init__(
        self, repeat_after_s: float = REPEAT_AFTER_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._repeat_after_s = repeat_after_s
        self._clock = clock
        self._told: dict[tuple[str, str], tuple[float, int]] = {}

    def pass_on(self, topic: str, sentence: str) -> str | None:
        """The line to log, or None while the kind was told a short while ago."""
        kind = (topic, re.sub(r"'[^']*'|\"[^\"]*\"|[-+]?[\d.]+", "#", sentence)[:200])
        now = self._clock()
        told, silent = self._told.get(kind, (-float("inf"), 0))
        if now - told < self._repeat_after_s:
            self._told[kind] = (told, silent + 1)
            return None
        if len(self._told) > 1000:  # Garbage can take any number of shapes.
            self._told.clear()
        self._told[kind] = (now, 0)
        return f"{sentence} ({silent} more like it were not told.)" if silent else sentence


def qos_advice(topic: str, kind: QoSPolicyKind, *, subscribing: bool) -> str:
    """What to do about an endpoint on ``topic`` that refuses our QoS, or we refuse its.

    Args:
        topic: The topic as it is on the graph, remapped.
        kind: The policy that does not fit.
        subscribing: Whether our end of the topic is a subscription.
    """
    ours, other = ("subscription", "publisher") if subscribing else ("publisher", "subscription")
    # A publisher must offer at least what the subscription asks for.
    words = {
        QoSPolicyKind.RELIABILITY: ("best_effort", "reliable"),
        QoSPolicyKind.DURABILITY: ("volatile", "transient_local"),
    }
    fault = f"{topic}: a {other} has an incompatible {kind.name.lower()}, so no message passes between us."
    if kind not in words:
        return f"{fault} Give both ends the same {kind.name.lower()}."
    less, more = words[kind]
    our_value, other_value = (less, more) if subscribing else (more, less)
    parameter = f"qos_overrides.{topic}.{ours}.{kind.name.lower()}"
    return (
        f"{fault} Set this node's parameter {parameter} to {our_value}, or make that {other} {other_value}."
    )


def loss_advice(topic: str, lost: int) -> str:
    """What to do about messages that were sent and never came, which best effort allows."""
    return f"{topic}: messages are lost on the way, {lost} so far. {AGAINST_LOSS}"


def pairing_advice(topic: str, publishers: int, frames_apart: tuple[str, str] | None = None) -> str:
    """What to do about images of which no view comes, because no camera info has their stamp and frame.

    Args:
        topic: Of the camera infos, as it is on the graph, remapped.
        publishers: How many nodes publish it.
        frames_apart: Of an image and a camera info of one stamp, where they differ.
    """
    if frames_apart is not None:
        image, info = frames_apart
        return (
            f"Images come in with frame_id {image!r}, and what has their stamps on {topic} with {info!r}, "
            "which may be another camera's: give both the frame_id of the camera's optical frame."
        )
    if publishers == 0:
        return f"Images come in, but nobody publishes {topic}: remap camera_info, or send ObjectView."
    return f"Images come in, but no message on {topic} has the stamp of one: give both the same header.stamp."


def missing_images_advice(publishers: Mapping[str, int]) -> str:
    """What to do about camera infos of which no view comes, because most find no image of their stamp.

    Args:
        publishers: How many nodes publish each topic of images, by its name on the graph, remapped.
    """
    published = [topic for topic, count in publishers.items() if count]
    if not published:
        topics = " or ".join(publishers)
        return f"Camera infos come in, but nobody publishes {topics}: remap it, or send ObjectView."
    topics = " and ".join(published)
    return f"{topics}: most camera infos find no image, so images get lost on the way. {AGAINST_LOSS}"


def type_advice(topic: str, name: str, carried: str, wanted: str, instead: str) -> str:
    """What to do about a topic whose messages are not of the type that is read there.

    Args:
        topic: As it is on the graph, remapped.
        name: The node's own name for it.
        carried: The type that a publisher sends there.
        wanted: The type that the node reads there.
        instead: The node's own name for a topic of the type that comes; empty where it has none.
    """
    where = f"remap {instead} to it and {name} elsewhere" if instead else f"remap {name} to one of that type"
    return f"{topic} carries {carried}, and {wanted} is read there: {where}."


def twin_advice(topic: str) -> str:
    """What to do about another node that publishes our topic."""
    return f"Somebody else publishes {topic} too: start one of two nodes with `-r __node:=NAME`."


class TopicWatch:
    """Tells topics of which nothing could be used between two looks."""

    def __init__(self) -> None:
        """Begin with the first look."""
        self._before: dict[str, tuple[int, int, int, int]] = {}

    def troubles(self, statistics: Statistics | None, lost: Mapping[str, int]) -> list[str]:
        """A sentence for each topic whose messages were all rejected since the last look, or mostly lost.

        Args:
            statistics: Of the scanner; None where there is none.
            lost: Messages that were sent and never came, by topic.
        """
        topics = {} if statistics is None else statistics.topics
        now = {
            topic: (counts.received, counts.used, counts.rejected, lost.get(topic, 0))
            for topic, counts in topics.items()
        } | {topic: (0, 0, 0, count) for topic, count in lost.items() if topic not in topics}
        told = []
        for topic, counts in now.items():
            before = self._before.get(topic, (0, 0, 0, 0))
            received, used, rejected, gone = (new - old for new, old in zip(counts, before, strict=True))
            if rejected > 0 and used <= 0:
                told.append(topics[topic].last_reason)
            elif gone > max(received, 0):
                told.append(loss_advice(topic, counts[3]))
        self._before = now
        return told


@dataclass(frozen=True)
class NodeHealth:
    """What the node knows of itself, beside its scanner's statistics."""

    state: str
    """Of the lifecycle."""
    failure: str = ""
    """Why the last configuration failed; empty where it did not."""
    publishers: Mapping[str, int] = field(default_factory=dict)
    """How many of them each topic listens to: none is why nothing arrives."""
    lost: Mapping[str, int] = field(default_factory=dict)
    """Messages that were sent and never came, by topic."""
    longest_callbacks_s: Mapping[str, float] = field(default_factory=dict)
    """The slowest callback so far, by topic."""
    incompatible: Mapping[str, str] = field(default_factory=dict)
    """What to do about QoS that does not fit, by topic."""
    troubles: Sequence[str] = ()
    """What was wrong with topics of which nothing could be used since the last report, a sentence each."""
    advice: Sequence[str] = ()
    """What else a person ought to know and do, a sentence each."""


def diagnostic_status(name: str, health: NodeHealth, statistics: Statistics | None) -> DiagnosticStatus:
    """The node's one diagnostics entry. The statistics are None while there is no scanner."""
    level, message = DiagnosticStatus.OK, health.state
    if statistics is not None:
        views = sum(scan.views for scan in statistics.scans.values())
        message = f"{health.state}, objects: {len(statistics.scans)}, views: {views}"
    failures = [] if statistics is None else [scan.failure for scan in statistics.scans.values()]
    worst = next(
        filter(None, [*health.incompatible.values(), *failures, *health.troubles, *health.advice]), ""
    )
    if worst:
        level, message = DiagnosticStatus.WARN, worst
    if health.failure:
        level, message = DiagnosticStatus.ERROR, health.failure
    values = [("state", health.state)]
    values += (("advice", sentence) for sentence in health.advice)
    values += ((f"{topic} QoS", advice) for topic, advice in health.incompatible.items())
    values += ((f"{topic} publishers", str(count)) for topic, count in health.publishers.items())
    values += ((f"{topic} lost", str(count)) for topic, count in health.lost.items())
    for topic, seconds in health.longest_callbacks_s.items():
        values.append((f"{topic} slowest callback ms", f"{1e3 * seconds:.2f}"))
    if statistics is not None:
        values += _statistics_values(statistics)
    return DiagnosticStatus(
        level=level,
        name=name,
        message=message,
        hardware_id="",
        values=[KeyValue(key=key, value=value) for key, value in values],
    )


def _statistics_values(statistics: Statistics) -> Iterator[tuple[str, str]]:
    for topic, counts in statistics.topics.items():
        yield f"{topic} received", str(counts.received)
        yield f"{topic} used", str(counts.used)
        yield f"{topic} rejected", str(counts.rejected)
        if counts.last_reason:
            yield f"{topic} last rejection", counts.last_reason
    for object_id, scan in statistics.scans.items():
        yield f"{object_id} views", str(scan.views)
        yield f"{object_id} views dropped", str(scan.dropped)
        yield f"{object_id} estimates", str(scan.estimates)
        if scan.latency_s is not None:
            yield f"{object_id} latency s", f"{scan.latency_s:.3f}"
        if scan.status:
            yield f"{object_id} status", scan.status
        if scan.weakest_pair is not None:
            i, j = scan.weakest_pair
            yield f"{object_id} weakest pair", f"{i}-{j} ({scan.weakest_probability:.2f} within 15 degrees)"
    yield "waiting for a counterpart", str(statistics.waiting)
    yield "images without a camera info", str(statistics.images_alone)
    yield "camera infos without an image", str(statistics.infos_alone)
    yield "failed estimates", str(statistics.failed)
    if statistics.last_failure:
        yield "last failure", statistics.last_failure
