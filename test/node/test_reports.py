from __future__ import annotations

import logging
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSCompatibility, QoSPolicyKind, QoSProfile, qos_check_compatible

from relpose_ros.node.reports import (
    LogForwarder,
    NodeHealth,
    Throttle,
    TopicWatch,
    diagnostic_status,
    loss_advice,
    pairing_advice,
    qos_advice,
    type_advice,
)
from relpose_ros.scanning.scanner import ScanStatistics, Statistics, TopicStatistics


class Clock:
    """Stands until it is set."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_kind_of_rejection_is_told_at_once_and_then_counted() -> None:
    clock = Clock()
    throttle = Throttle(5.0, clock)
    assert throttle.pass_on("/image", "stamp 10.5: the width is 0.") == "stamp 10.5: the width is 0."
    for tenth in range(1, 50):
        clock.now = 0.1 * tenth
        assert throttle.pass_on("/image", f"stamp {10.5 + tenth}: the width is 0.") is None
    assert throttle.pass_on("/other", "stamp 10.5: the width is 0.") is not None
    assert throttle.pass_on("/image", "stamp 10.5: the encoding is 'x'.") is not None
    assert throttle.pass_on("/image", "stamp 10.5: the encoding is 'y'.") is None
    clock.now = 5.0
    line = throttle.pass_on("/image", "stamp 99.0: the width is 0.")
    assert line is not None
    assert line.startswith("stamp 99.0: the width is 0.")
    assert "49" in line
    clock.now = 10.0
    assert throttle.pass_on("/image", "stamp 100.0: the width is 0.") == "stamp 100.0: the width is 0."


def test_a_throttle_does_not_grow_without_end() -> None:
    throttle = Throttle()
    for k in range(5000):
        throttle.pass_on("/image", "a" * (k % 150) + "b" * (k // 150) + " is no encoding.")
    assert len(throttle._told) <= 1001


@pytest.mark.parametrize("level", ["debug", "info", "warning", "error"])
def test_records_keep_their_level(level: str) -> None:
    told = []

    class RosLogger:
        def __getattr__(self, name: str) -> Any:
            return lambda text: told.append((name, text))

    logger = logging.Logger("relpose_ros.test")
    logger.addHandler(LogForwarder(RosLogger()))
    getattr(logger, level)("%d views of %r", 3, "mug")
    assert told == [(level, "3 views of 'mug'")]


@pytest.mark.parametrize("subscribing", [True, False])
@pytest.mark.parametrize("kind", [QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY])
def test_the_advice_about_qos_helps(kind: QoSPolicyKind, subscribing: bool) -> None:
    """Each of the two changes makes compatible what was not."""
    policy = kind.name.lower()
    values = {
        "reliability": ("best_effort", "reliable"),
        "durability": ("volatile", "transient_local"),
    }[policy]

    def fits(offered: str, requested: str) -> bool:
        profiles = [QoSProfile(depth=1) for _ in range(2)]
        for profile, value in zip(profiles, (offered, requested), strict=True):
            setattr(profile, policy, type(getattr(profile, policy))[value.upper()])
        return bool(qos_check_compatible(*profiles)[0] != QoSCompatibility.ERROR)

    offered, requested = values
    assert not fits(offered, requested)
    advice = qos_advice("/image", kind, subscribing=subscribing)
    ours, theirs = ("subscription", "publisher") if subscribing else ("publisher", "subscription")
    ends = {"publisher": offered, "subscription": requested}
    (our_value,) = (v for v in values if f"qos_overrides./image.{ours}.{policy} to {v}" in advice)
    (their_value,) = (v for v in values if f"make that {theirs} {v}" in advice)
    assert fits(*(ends | {ours: our_value}).values())
    assert fits(*(ends | {theirs: their_value}).values())


def counted(**topics: tuple[int, int, int]) -> Statistics:
    counts = {f"/{name}": TopicStatistics(*each, f"{name} is wrong") for name, each in topics.items()}
    return Statistics(counts, {}, 0, None, 0, 0, None, False, 0, "")


def test_topics_of_which_nothing_was_used_since_the_last_look_are_told() -> None:
    watch = TopicWatch()
    assert watch.troubles(None, {}) == []
    assert watch.troubles(counted(image=(5, 3, 2), info=(4, 0, 0)), {}) == [], "some were used"
    assert watch.troubles(counted(image=(7, 3, 4), info=(9, 0, 0)), {}) == ["image is wrong"]
    assert watch.troubles(counted(image=(7, 3, 4), info=(9, 0, 0)), {}) == [], "nothing came"
    assert watch.troubles(counted(image=(9, 4, 5), info=(9, 0, 0)), {}) == []
    assert watch.troubles(counted(image=(12, 7, 5)), {"/image": 2, "/other": 1}) == [loss_advice("/other", 1)]
    assert watch.troubles(counted(image=(13, 8, 5)), {"/image": 4, "/other": 1}) == [loss_advice("/image", 4)]
    assert watch.troubles(counted(), {}) == [], "configured anew"
    assert watch.troubles(counted(image=(1, 0, 1)), {}) == ["image is wrong"]


def test_what_the_package_logs_again_and_again_is_counted() -> None:
    told: list[str] = []
    ros_logger = SimpleNamespace(info=told.append, warning=told.append, error=told.append, debug=told.append)
    logger = logging.Logger("relpose_ros.test")
    logger.addHandler(LogForwarder(ros_logger))
    for k in range(300):
        logger.warning("The scan of %r with %d views is forgotten.", f"track {k}", k)
        logger.error("The estimate from %d views failed.", k)
        logger.debug("debug %d", k)
    assert told[:2] == [
        "The scan of 'track 0' with 0 views is forgotten.",
        "The estimate from 0 views failed.",
    ]
    assert sum(not line.startswith("debug") for line in told) == 2
    assert len(told) == 302


def test_images_of_another_frame_than_their_camera_infos_are_told() -> None:
    advice = pairing_advice("/camera_info", 1, ("left", "right"))
    assert "frame_id 'left'" in advice
    assert "/camera_info with 'right'" in advice
    assert "has the stamp of one" in pairing_advice("/camera_info", 1)
    assert "nobody publishes /camera_info" in pairing_advice("/camera_info", 0)


def test_a_topic_of_another_type_is_told_with_what_to_remap() -> None:
    told = type_advice(
        "/cam", "image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image", "image/compressed"
    )
    assert "/cam carries sensor_msgs/msg/CompressedImage, and sensor_msgs/msg/Image is read there" in told
    assert "remap image/compressed to it" in told
    assert "remap image to one of that type" in type_advice("/cam", "image", "a/msg/A", "b/msg/B", "")


def test_diagnostics_tell_the_worst_first() -> None:
    statistics = Statistics(
        topics={"/image": TopicStatistics(received=9, used=4, rejected=2, last_reason="the width is 0")},
        scans={"mug": ScanStatistics(4, 3, 1, 0.25, "enough", (1, 2), 0.875)},
        waiting=3,
        unpaired_s=None,
        images_alone=2,
        infos_alone=7,
        frames_apart=None,
        images_missing=False,
        failed=0,
        last_failure="",
    )
    healthy = NodeHealth("active", publishers={"/image": 1}, longest_callbacks_s={"/image": 0.004})
    good = diagnostic_status("/scan_node", healthy, statistics)
    assert good.level == DiagnosticStatus.OK
    assert good.message == "active, objects: 1, views: 4"
    values = {each.key: each.value for each in good.values}
    assert values["/image publishers"] == "1"
    assert values["/image slowest callback ms"] == "4.00"
    assert values["/image last rejection"] == "the width is 0"
    assert values["mug weakest pair"] == "1-2 (0.88 within 15 degrees)"
    assert values["mug latency s"] == "0.250"
    assert values["camera infos without an image"] == "7"

    failed = replace(statistics, failed=1, last_failure="no memory is left")
    scan = replace(statistics.scans["mug"], failure="no memory is left")
    bad = diagnostic_status("/scan_node", healthy, replace(failed, scans={"mug": scan}))
    assert (bad.level, bad.message) == (DiagnosticStatus.WARN, "no memory is left")
    mended = diagnostic_status("/scan_node", healthy, failed)
    assert mended.level == DiagnosticStatus.OK
    assert "no memory is left" in [each.value for each in mended.values]

    deaf = replace(healthy, incompatible={"/image": "set the QoS"})
    told = diagnostic_status("/scan_node", deaf, statistics)
    assert (told.level, told.message) == (DiagnosticStatus.WARN, "set the QoS")
    advised = diagnostic_status("/scan_node", replace(healthy, advice=["do this", "do that"]), statistics)
    assert (advised.level, advised.message) == (DiagnosticStatus.WARN, "do this")
    assert [each.value for each in advised.values if each.key == "advice"] == ["do this", "do that"]
    troubled = diagnostic_status("/scan_node", replace(healthy, troubles=["nothing is used"]), statistics)
    assert (troubled.level, troubled.message) == (DiagnosticStatus.WARN, "nothing is used")
    lost = replace(deaf, state="unconfigured", failure="no such weights")
    told = diagnostic_status("/scan_node", lost, None)
    assert (told.level, told.message) == (DiagnosticStatus.ERROR, "no such weights")
