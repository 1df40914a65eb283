"""How the node subscribes: as reliably as its publishers allow."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSProfile, ReliabilityPolicy
from relpose_ros.msg import ObjectView
from sensor_msgs.msg import CompressedImage, Image

from relpose_ros.node.lifecycle_node import ScanNode
from relpose_ros.scanning.scanner import Scanner
from relpose_ros.scanning.settings import ScanSettings

if TYPE_CHECKING:
    from collections.abc import Callable

    import pytest

IMAGE, CAMERA_INFO, OBJECT_VIEW = "/image", "/camera_info", "/object_view"
RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
OFTEN = "diagnostics_period_s:=0.1"


def asked_for(graph: Any, topic: str) -> list[ReliabilityPolicy]:
    return [each.qos_profile.reliability for each in graph.node.get_subscriptions_info_by_topic(topic)]


def test_images_are_as_reliable_as_their_publishers(
    start_without_network: Callable[..., Any], new_graph: Any, make: Any
) -> None:
    node = start_without_network(OFTEN)
    node.wait_for("Waiting for views")
    new_graph.publish(IMAGE, *(make.image(10.0 + k, 960, 540) for k in range(5)))
    new_graph.publish(CAMERA_INFO, *(make.camera_info(10.0 + k, 960, 540) for k in range(5)))
    new_graph.wait_until(lambda: new_graph.diagnostic("object views") == "5", "five of five")
    assert asked_for(new_graph, IMAGE) == [RELIABLE]

    best_effort = new_graph.publisher(Image, IMAGE, BEST_EFFORT)
    assert asked_for(new_graph, IMAGE) == [BEST_EFFORT]
    assert asked_for(new_graph, CAMERA_INFO) == [RELIABLE]
    assert node.wait_for(IMAGE, "best effort", "a publisher is")
    for reliability in (RELIABLE, BEST_EFFORT):
        received = new_graph.count(IMAGE, "received")

        def publish(stamp: float, reliability: ReliabilityPolicy = reliability) -> None:
            new_graph.publish(IMAGE, make.image(100.0 + stamp), reliability=reliability)

        new_graph.publish_until(
            lambda received=received: new_graph.count(IMAGE, "received") > received, "an image", publish
        )

    assert new_graph.node.destroy_publisher(best_effort)
    new_graph.wait_until(lambda: asked_for(new_graph, IMAGE) == [RELIABLE], "a reliable subscription")
    new_graph.wait_until(lambda: new_graph.diagnostic(f"{IMAGE} publishers") == "1", "the other publisher")
    assert node.wait_for(IMAGE, "reliable", "every publisher is")
    received = new_graph.count(IMAGE, "received")
    assert received >= 7, "the count goes on"
    new_graph.publish(IMAGE, make.image(200.0))
    new_graph.wait_until(lambda: new_graph.count(IMAGE, "received") == received + 1, "another image")
    assert new_graph.diagnostic("object views") == "5"
    assert not node.told("WARN", "reliability"), node.log
    assert node.end() == 0
    assert not node.told("A callback failed"), node.log


def test_an_override_of_the_reliability_stays(
    start_without_network: Callable[..., Any], new_graph: Any
) -> None:
    node = start_without_network(
        OFTEN,
        "qos_overrides./image.subscription.reliability:=best_effort",
        "qos_overrides./camera_info.subscription.reliability:=reliable",
        "qos_overrides./object_view.subscription.depth:=7",
    )
    node.wait_for("Waiting for views")
    image = new_graph.node.create_publisher(Image, IMAGE, QoSProfile(depth=1, reliability=RELIABLE))
    for topic in (CAMERA_INFO, OBJECT_VIEW):  # of any type: what it offers is what counts
        new_graph.node.create_publisher(Image, topic, QoSProfile(depth=1, reliability=BEST_EFFORT))
    new_graph.wait_until(lambda: asked_for(new_graph, OBJECT_VIEW) == [BEST_EFFORT], "a look at the topics")
    assert image.get_subscription_count() == 1
    assert asked_for(new_graph, IMAGE) == [BEST_EFFORT]
    assert asked_for(new_graph, CAMERA_INFO) == [RELIABLE]
    assert node.wait_for("from now on")  # the line comes after the subscription
    assert len(node.told("from now on")) == 1, "the others are not made anew"
    assert new_graph.parameter("qos_overrides./image.subscription.reliability") == "best_effort"
    assert new_graph.parameter("qos_overrides./object_view.subscription.depth") == 7
    assert node.end() == 0


def test_what_waits_is_taken_when_the_reliability_changes(
    domain: int, new_graph: Any, make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing executes this node's callbacks, so what was sent waits."""
    monkeypatch.setattr(ScanNode, "_load_estimator", lambda _: None)
    context = rclpy.Context()
    context.init(domain_id=domain)
    node = ScanNode(context=context, enable_rosout=False)
    try:
        node.autostart()
        publisher = new_graph.node.create_publisher(Image, IMAGE, QoSProfile(depth=9, reliability=RELIABLE))
        new_graph.wait_until(lambda: publisher.get_subscription_count() == 1, "the subscription")
        for k in range(3):
            publisher.publish(make.image(10.0 + k))
        assert publisher.wait_for_all_acked()
        new_graph.node.create_publisher(Image, IMAGE, QoSProfile(depth=9, reliability=BEST_EFFORT))

        def changed() -> bool:
            node._adapt_inputs()
            return asked_for(new_graph, IMAGE) == [BEST_EFFORT]

        new_graph.wait_until(changed, "a best effort subscription")
        assert node._scanner is not None
        assert node._scanner.statistics().topics[IMAGE].received == 3
    finally:
        node.finalize()
        node.destroy_node()
        context.shutdown()


def test_camera_infos_without_images_are_told(
    start_without_network: Callable[..., Any], new_graph: Any, make: Any
) -> None:
    node = start_without_network(OFTEN)
    node.wait_for("Waiting for views")

    def publish_info(stamp: float) -> None:
        new_graph.publish(CAMERA_INFO, make.camera_info(stamp))

    new_graph.publish_until(
        lambda: node.told("WARN", "nobody publishes /image or /image/compressed"), "a warning", publish_info
    )
    views = new_graph.publisher(ObjectView, OBJECT_VIEW, RELIABLE)
    new_graph.wait_until(lambda: new_graph.diagnostic("advice") is None, "views that need no images")
    assert new_graph.node.destroy_publisher(views)
    new_graph.publisher(Image, IMAGE, RELIABLE)
    node.wait_for("WARN", IMAGE, "most camera infos find no image", "reliable", "net.core.rmem_max")
    status = new_graph.diagnostics()
    assert status.level == DiagnosticStatus.WARN
    assert "most camera infos find no image" in status.message
    assert int(new_graph.diagnostic("camera infos without an image")) > 2

    def publish_both(stamp: float) -> None:
        publish_info(1000.0 + stamp)
        new_graph.publish(IMAGE, make.image(1000.0 + stamp))

    new_graph.publish_until(lambda: new_graph.diagnostic("advice") is None, "its end", publish_both)
    assert "camera infos" not in new_graph.diagnostics().message
    assert node.end() == 0


def test_a_topic_of_another_type_is_told(
    start_without_network: Callable[..., Any], new_graph: Any, make: Any
) -> None:
    """The commonest mistake: a camera's compressed topic where its raw one is expected."""
    node = start_without_network(OFTEN)
    node.wait_for("Waiting for views")
    other = new_graph.node.create_publisher(CompressedImage, IMAGE, QoSProfile(depth=1))
    words = "/image carries sensor_msgs/msg/CompressedImage, and sensor_msgs/msg/Image is read there"
    assert node.wait_for("WARN", words, "remap image/compressed to it")
    assert words in new_graph.diagnostics().message
    assert new_graph.node.destroy_publisher(other)
    new_graph.wait_until(lambda: new_graph.diagnostic("advice") is None, "its end")


def test_diagnostics_warn_while_nothing_that_comes_is_of_use(
    start_without_network: Callable[..., Any], new_graph: Any, make: Any
) -> None:
    node = start_without_network(OFTEN)
    node.wait_for("Waiting for views")
    stamps = itertools.count(10)

    def warned() -> bool:
        view = make.object_view(float(next(stamps)), "mug")
        view.image.encoding = "foo8"
        new_graph.publish(OBJECT_VIEW, view)
        status = new_graph.diagnostics()
        return status.level == DiagnosticStatus.WARN and "foo8" in status.message

    new_graph.wait_until(warned, "a warning")
    new_graph.publish(OBJECT_VIEW, make.object_view(float(next(stamps)), "mug"))
    new_graph.wait_until(lambda: new_graph.diagnostics().level == DiagnosticStatus.OK, "its end")


def test_who_asks_gets_a_turn_though_views_keep_coming(domain: int) -> None:
    context = rclpy.Context()
    context.init(domain_id=domain)
    node = ScanNode(context=context, enable_rosout=False)
    try:
        node._worker = ThreadPoolExecutor(1)
        node._scanner = Scanner(SimpleNamespace(), ScanSettings())  # type: ignore[arg-type]
        node._scanner.pending = lambda: True  # type: ignore[method-assign]
        node._ask_for_estimate()
        asked = node._submit(lambda: "an answer")
        assert asked is not None
        assert asked.result(60) == "an answer"
    finally:
        assert node.close(60)
        node.destroy_node()
        context.shutdown()


def test_what_was_forgotten_meanwhile_is_not_told(monkeypatch: pytest.MonkeyPatch, domain: int) -> None:
    """A service has answered that it is gone; only what takes it back goes out."""
    context = rclpy.Context()
    context.init(domain_id=domain)
    node = ScanNode(context=context, enable_rosout=False)
    try:
        told: list[Any] = []
        monkeypatch.setattr(node, "_publish", told.extend)
        gone, back, stands = (
            SimpleNamespace(estimate=SimpleNamespace(cameras=n)) for n in ((1, 2), (), (3,))
        )
        scanner: Any = SimpleNamespace(stands=lambda result: result is stands)
        results = node._estimate(scanner, lambda: [gone, back, stands])  # type: ignore[list-item]
        assert results == told == [back, stands]
    finally:
        node.destroy_node()
        context.shutdown()
