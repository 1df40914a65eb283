"""The node over real DDS: views go in from this process, estimates come out of another one."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, cast

import pytest
from geometry_msgs.msg import PoseArray
from lifecycle_msgs.msg import Transition
from rclpy.exceptions import InvalidHandle
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from relpose_ros.msg import ScanEstimate
from visualization_msgs.msg import Marker, MarkerArray

from relpose_ros.node import scan_node

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

OBJECT_VIEW, IMAGE, COMPRESSED, CAMERA_INFO = "/object_view", "/image", "/image/compressed", "/camera_info"
LAST = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


@pytest.fixture
def node(running: Any, graph: Any) -> Iterator[Any]:
    """That node without any view, and no message of an earlier test on its way."""
    graph.forget()
    running.lines.clear()
    yield running
    assert running.process.poll() is None, "the node did not survive"


def stamp_s(message: Any) -> float:
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


def test_poses_come_from_the_second_view_on(node: Any, graph: Any, make: Any) -> None:
    graph.publish(OBJECT_VIEW, make.object_view(10.0, "mug"))
    graph.wait_until(lambda: graph.diagnostic("mug views") == "1", "the first view")
    answer = graph.trigger("estimate_now")
    assert (answer.success, answer.message) == (False, "No object has two views yet.")
    assert not graph.estimates
    graph.publish(OBJECT_VIEW, make.object_view(11.0, "mug"))
    first = graph.estimate_of("mug", views=2)
    assert [(pair.i, pair.j) for pair in first.pairs] == [(0, 1)]
    graph.publish(OBJECT_VIEW, make.object_view(12.0, "mug"))
    second = graph.estimate_of("mug", views=3)
    assert [stamp_s(camera) for camera in second.cameras] == [10.0, 11.0, 12.0]
    assert second.header.frame_id == "object"
    assert stamp_s(second) == 12.0
    assert second.seconds > 0.0

    poses = graph.wait_until(lambda: [p for p in graph.poses if len(p.poses) == 3], "poses")[0]
    assert poses.header == second.header
    assert poses.poses == [camera.pose.pose for camera in second.cameras]
    markers = graph.wait_until(
        lambda: [m for m in graph.markers if m.markers[-1].header == second.header], "markers"
    )
    assert markers[0].markers[0].action == Marker.DELETEALL


@pytest.mark.parametrize("reliability", [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT])
def test_images_with_camera_infos_of_either_kind_of_publisher(
    node: Any, graph: Any, make: Any, reliability: ReliabilityPolicy
) -> None:
    def publish(stamp: float) -> None:
        graph.publish(IMAGE, make.image(stamp), reliability=reliability)
        graph.publish(CAMERA_INFO, make.camera_info(stamp), reliability=reliability)

    graph.publish_until(lambda: graph.estimates, "an estimate", publish)
    first = graph.estimates[0]
    assert len(first.pairs) == len(first.cameras) * (len(first.cameras) - 1) // 2


def test_compressed_images(node: Any, graph: Any, make: Any) -> None:
    def publish(stamp: float) -> None:
        graph.publish(CAMERA_INFO, make.camera_info(stamp))
        graph.publish(COMPRESSED, make.compressed(stamp))

    graph.publish_until(lambda: graph.estimates, "an estimate", publish)
    assert {each.object_id for each in graph.estimates} == {"object"}


def test_who_comes_late_gets_the_last_estimate(node: Any, graph: Any, make: Any) -> None:
    graph.publish(OBJECT_VIEW, *(make.object_view(stamp, "mug") for stamp in (10.0, 11.0)))
    last = graph.estimate_of("mug", views=2)
    late = graph.collect(ScanEstimate, "/scan_node/estimate", LAST)
    graph.wait_until(lambda: late, "the estimate that was published before")
    assert late == [last]


def test_what_was_told_of_views_that_are_forgotten_is_taken_back(node: Any, graph: Any, make: Any) -> None:
    graph.publish(OBJECT_VIEW, *(make.object_view(stamp, "vase") for stamp in (10.0, 11.0)))
    last = graph.estimate_of("vase", views=2)
    assert graph.trigger("reset").message == "2 views forgotten."
    answer = graph.wait_until(lambda: [e for e in graph.taken_back if e.object_id == "vase"], "no estimate")[
        0
    ]
    assert answer.header == last.header
    assert answer.status == "no view is left: a client asked for it"
    assert answer.verdict == ScanEstimate.VERDICT_ONE_MORE_VIEW
    late = {
        topic: graph.collect(kind, f"/scan_node/{topic}", LAST)
        for topic, kind in (("estimate", ScanEstimate), ("poses", PoseArray), ("markers", MarkerArray))
    }
    graph.wait_until(lambda: all(late.values()), "the last message of each topic")
    assert late["estimate"] == [answer]
    assert [(each.header, list(each.poses)) for each in late["poses"]] == [(answer.header, [])]
    (shown,) = late["markers"]
    assert [(each.header, each.action) for each in shown.markers] == [(answer.header, Marker.DELETEALL)]


def test_what_stands_of_another_object_is_still_shown(node: Any, graph: Any, make: Any) -> None:
    assert graph.set_parameter("max_scans", 2) == (True, "")
    graph.publish(OBJECT_VIEW, *(make.object_view(stamp, "fork") for stamp in (10.0, 11.0)))
    graph.estimate_of("fork", views=2)
    graph.publish(OBJECT_VIEW, *(make.object_view(stamp, "knife") for stamp in (20.0, 21.0)))
    last = graph.estimate_of("knife", views=2)
    graph.publish(OBJECT_VIEW, make.object_view(30.0, "spoon"))
    graph.wait_until(lambda: [each for each in graph.taken_back if each.object_id == "fork"], "no fork")
    late = {
        topic: graph.collect(kind, f"/scan_node/{topic}", LAST)
        for topic, kind in (("estimate", ScanEstimate), ("poses", PoseArray), ("markers", MarkerArray))
    }
    graph.wait_until(lambda: all(late.values()), "the last message of each topic")
    assert late["estimate"] == [last]
    assert [len(each.poses) for each in late["poses"]] == [2]
    assert [each.action for each in late["markers"][0].markers].count(Marker.ADD) > 0
    assert graph.set_parameter("max_scans", 4) == (True, "")


def test_objects_are_estimated_apart(node: Any, graph: Any, make: Any) -> None:
    views = [make.object_view(10.0 + k, object_id) for k in range(2) for object_id in ("mug", "bowl")]
    graph.publish(OBJECT_VIEW, *views, make.object_view(12.0, "mug"))
    assert stamp_s(graph.estimate_of("mug", views=3)) == 12.0
    assert stamp_s(graph.estimate_of("bowl", views=2)) == 11.0


def test_a_burst_of_fifty_views(node: Any, graph: Any, make: Any) -> None:
    stamps = [10.0 + 0.1 * k for k in range(50)]
    before = graph.count(OBJECT_VIEW, "received")
    assert graph.set_parameter("keep", "latest") == (True, "")
    try:
        graph.publish(OBJECT_VIEW, *(make.object_view(stamp, "mug") for stamp in stamps))
        graph.wait_until(
            lambda: any(stamp_s(each) == pytest.approx(stamps[-1]) for each in graph.estimates),
            "the last view",
        )
        last = max(graph.estimates, key=stamp_s)
        assert [stamp_s(camera) for camera in last.cameras] == pytest.approx(
            [14.2 + 0.1 * k for k in range(8)]
        )
        assert graph.count(OBJECT_VIEW, "received") == before + 50
        print(f"{len(graph.estimates)} estimates of 50 views that came at once")
    finally:
        assert graph.set_parameter("keep", "spread") == (True, "")


@pytest.mark.parametrize("covariance", [False, True])
def test_camera_poses_of_the_robot(node: Any, graph: Any, make: Any, covariance: bool) -> None:
    """What these weights make of noise contradicts any pose: the estimate says that they were heard."""
    topic = "/camera_pose_with_covariance" if covariance else "/camera_pose"
    before, rejected = graph.count(topic, "used"), graph.count(topic, "rejected")
    stamps = (10.0, 11.0, 12.0)

    graph.publish(OBJECT_VIEW, *(make.object_view(stamp, "cup") for stamp in stamps))
    first = graph.estimate_of("cup", views=3)
    assert first.object_pose.header.frame_id == ""
    graph.publish(topic, *(make.camera_pose(stamp, covariance=covariance) for stamp in stamps))
    graph.wait_until(lambda: graph.count(topic, "used") == before + 3, "the poses")
    graph.wait_until(
        lambda: (
            "the robot's camera poses do not tell the scale" in graph.estimates[-1].status
            or graph.estimates[-1].object_pose.header.frame_id == "base"
        ),
        "an estimate that heard of the robot",
    )
    bad = make.camera_pose(13.0, covariance=covariance)
    (bad.pose.pose if covariance else bad.pose).orientation.w = float("nan")
    graph.publish(topic, bad)
    graph.wait_until(lambda: graph.count(topic, "rejected") == rejected + 1, "a rejection")
    assert "a rotation's quaternion has 1" in graph.diagnostic(f"{topic} last rejection")
    graph.publish(OBJECT_VIEW, make.object_view(13.0, "cup"))
    assert len(graph.estimate_of("cup", views=4).cameras) == 4


def test_garbage_in_between_costs_nothing(node: Any, graph: Any, make: Any) -> None:
    truncated, unknown, empty = (make.object_view(11.0 + 0.1 * k, "mug") for k in range(3))
    truncated.image.data = truncated.image.data[:100]
    unknown.image.encoding = "32FC1"
    empty.image.width = 0
    outside = make.object_view(11.3, "mug")
    outside.box.x_offset = 4000
    not_a_number = make.object_view(11.4, "mug")
    not_a_number.k[0] = float("nan")
    no_jpeg = make.compressed(11.5)
    no_jpeg.data = no_jpeg.data[40:]
    garbage = [truncated, unknown, empty, outside, not_a_number]

    rejected = graph.count(OBJECT_VIEW, "rejected")
    graph.publish(OBJECT_VIEW, make.object_view(10.0, "mug"), *garbage)

    def publish(stamp: float) -> None:
        no_jpeg.header = make.header(stamp)
        graph.publish(CAMERA_INFO, make.camera_info(stamp))
        graph.publish(COMPRESSED, no_jpeg)

    graph.publish_until(
        lambda: node.told("WARN", COMPRESSED, "are neither JPEG nor PNG"), "a warning", publish
    )
    graph.publish(OBJECT_VIEW, make.object_view(12.0, "mug"), make.object_view(9.5, "mug"))
    estimate = graph.estimate_of("mug", views=2)
    assert [stamp_s(camera) for camera in estimate.cameras] == [10.0, 12.0]
    graph.wait_until(lambda: graph.count(OBJECT_VIEW, "rejected") == rejected + 6, "six rejections")
    for stamp in ("11.000", "11.100", "11.200", "11.300", "11.400", "9.500"):
        assert node.told("WARN", OBJECT_VIEW, stamp), (stamp, node.log)


def test_the_same_garbage_again_and_again_is_told_once(node: Any, graph: Any, make: Any) -> None:
    rejected = graph.count(OBJECT_VIEW, "rejected")
    for k in range(20):
        view = make.object_view(20.0 + k, "cup")
        view.box.height = 0
        graph.publish(OBJECT_VIEW, view)
    graph.wait_until(lambda: graph.count(OBJECT_VIEW, "rejected") == rejected + 20, "twenty rejections")
    assert len(node.told("WARN", OBJECT_VIEW)) == 1
    assert "39.000" in graph.diagnostic(f"{OBJECT_VIEW} last rejection")


def test_a_bag_that_loops_starts_the_scan_anew(node: Any, graph: Any, make: Any) -> None:
    loop = [100.0 + k for k in range(4)]
    graph.publish(OBJECT_VIEW, *(make.object_view(stamp, "mug") for stamp in loop))
    graph.estimate_of("mug", views=4)
    graph.estimates.clear()
    graph.publish(OBJECT_VIEW, *(make.object_view(stamp, "mug") for stamp in loop[:3]))
    estimate = graph.estimate_of("mug", views=3)
    assert [stamp_s(camera) for camera in estimate.cameras] == loop[:3]
    assert node.told("jumped backwards")


def test_services(node: Any, graph: Any, make: Any) -> None:
    assert not graph.trigger("drop_last_view").success
    graph.publish(OBJECT_VIEW, *(make.object_view(10.0 + k, "mug") for k in range(3)))
    graph.estimate_of("mug", views=3)
    graph.estimates.clear()
    answer = graph.trigger("drop_last_view")
    assert answer.success
    assert "mug" in answer.message
    assert stamp_s(graph.estimate_of("mug", views=2)) == 11.0
    graph.estimates.clear()
    answer = graph.trigger("estimate_now")
    assert answer.success
    assert answer.message == f"mug: {graph.estimate_of('mug', views=2).status}"
    for service, message in (("drop_last_view", "is dropped."), ("reset", "1 views forgotten.")):
        answer = graph.trigger(service)
        assert answer.success
        assert answer.message.endswith(message)
    status = "one more view: only one is left"
    graph.wait_until(lambda: [each for each in graph.taken_back if each.status == status], status)


def test_views_that_other_parameters_leave_are_estimated_at_once(node: Any, graph: Any, make: Any) -> None:
    graph.publish(OBJECT_VIEW, *(make.object_view(10.0 + k, "mug") for k in range(3)))
    graph.estimate_of("mug", views=3)
    assert graph.set_parameter("max_views", 2) == (True, "")
    try:
        graph.estimate_of("mug", views=2)
    finally:
        assert graph.set_parameter("max_views", 8) == (True, "")


def test_other_evidence_counts_at_once(node: Any, graph: Any, make: Any) -> None:
    graph.publish(OBJECT_VIEW, *(make.object_view(10.0 + k, "mug") for k in range(2)))
    assert not graph.estimate_of("mug", views=2).scale_known
    graph.estimates.clear()
    assert graph.set_parameter("first_view_distance", 0.5) == (True, "")
    try:
        assert graph.estimate_of("mug", views=2).scale_known
    finally:
        assert graph.set_parameter("first_view_distance", 0.0) == (True, "")


def test_images_without_camera_infos_are_told(node: Any, graph: Any, make: Any) -> None:
    def publish(stamp: float) -> None:
        graph.publish(IMAGE, make.image(stamp))

    graph.publish_until(lambda: node.told("WARN", "Images come in", "/camera_info"), "a warning", publish)
    assert "Images come in" in graph.diagnostics().message
    assert len(node.told("WARN", "Images come in")) == 1

    def publish_both(stamp: float) -> None:
        graph.publish(IMAGE, make.image(100 + stamp))
        graph.publish(CAMERA_INFO, make.camera_info(100 + stamp))

    graph.publish_until(lambda: graph.diagnostic("advice") is None, "its end", publish_both)


def test_another_node_of_the_same_name_is_told(node: Any, graph: Any) -> None:
    twin = graph.node.create_publisher(ScanEstimate, "/scan_node/estimate", LAST)
    try:
        node.wait_for("WARN", "Somebody else publishes /scan_node/estimate", "__node:=NAME")
        assert "Somebody else" in graph.diagnostics().message
    finally:
        graph.node.destroy_publisher(twin)
    graph.wait_until(lambda: graph.diagnostic("advice") is None, "its end")


def test_parameters_are_described_and_judged(node: Any, graph: Any) -> None:
    limits = graph.descriptor("max_views").integer_range[0]
    assert (limits.from_value, limits.to_value) == (2, 8)
    assert "latest" in graph.descriptor("keep").additional_constraints
    for name, value, complaint in (
        ("max_views", 9, "max_views"),
        ("max_views", "many", "INTEGER"),
        ("keep", "nonsense", "first, latest, spread"),
        ("object_frame", "", "object_frame"),
        ("object_frame", None, ""),
        ("backward_jump_s", float("nan"), "backward_jump_s"),
        ("weights", "/elsewhere", "`ros2 lifecycle set /scan_node cleanup`"),
    ):
        accepted, reason = graph.set_parameter(name, value)
        assert not accepted, (name, value)
        assert complaint in reason
    assert graph.set_parameter("object_frame", "thing") == (True, "")
    assert graph.set_parameter("object_frame", "object") == (True, "")


def test_how_long_a_full_hd_frame_holds_the_callbacks(node: Any, graph: Any, make: Any) -> None:
    before, sent = graph.count(IMAGE, "received"), []

    def publish(stamp: float) -> None:
        graph.publish(CAMERA_INFO, make.camera_info(stamp, 1920, 1080))
        graph.publish(IMAGE, make.image(stamp, 1920, 1080))
        sent.append(stamp)

    graph.publish_until(lambda: graph.estimates, "an estimate of two frames", publish)
    received = graph.count(IMAGE, "received") - before
    if received < len(sent) - 1:
        assert graph.count(IMAGE, "lost") > 0
    slowest = graph.diagnostic(f"{IMAGE} slowest callback ms")
    print(f"1920x1080 rgb8, {received} of {len(sent)} frames got through: slowest callback {slowest} ms")


def test_transitions(node: Any, graph: Any, make: Any, tmp_path: Path) -> None:
    graph.publish(OBJECT_VIEW, *(make.object_view(10.0 + k, "mug") for k in range(2)))
    graph.estimate_of("mug", views=2)

    assert graph.change_state(Transition.TRANSITION_DEACTIVATE)
    refusal = graph.trigger("estimate_now")
    assert not refusal.success
    assert "`ros2 lifecycle set /scan_node activate`" in refusal.message
    graph.publish(OBJECT_VIEW, make.object_view(12.0, "mug"))
    assert not graph.change_state(Transition.TRANSITION_CONFIGURE), "it is configured"
    assert graph.state() == "inactive"
    assert graph.change_state(Transition.TRANSITION_ACTIVATE)
    graph.publish(OBJECT_VIEW, make.object_view(13.0, "mug"))
    estimate = graph.estimate_of("mug", views=3)
    assert [stamp_s(camera) for camera in estimate.cameras] == [10.0, 11.0, 13.0]

    weights = graph.parameter("weights")
    threads = []
    for _ in range(2):
        assert graph.change_state(Transition.TRANSITION_DEACTIVATE)
        assert graph.change_state(Transition.TRANSITION_CLEANUP)
        assert graph.state() == "unconfigured"
        graph.wait_until(lambda: graph.node.count_subscribers(OBJECT_VIEW) == 0, "topics that are gone")
        threads.append(node.threads())

        nowhere = str(tmp_path / "nowhere.safetensors")
        assert graph.set_parameter("weights", nowhere) == (True, "")
        assert not graph.change_state(Transition.TRANSITION_CONFIGURE)
        assert graph.state() == "unconfigured"
        assert node.told("ERROR", nowhere, "`ros2 lifecycle set /scan_node configure`")
        assert nowhere in graph.diagnostics().message

        assert graph.set_parameter("weights", weights) == (True, "")
        assert graph.change_state(Transition.TRANSITION_CONFIGURE)
        assert graph.change_state(Transition.TRANSITION_ACTIVATE)
    assert threads[0] == threads[1]
    status = "no view is left: the node was cleaned up"
    graph.wait_until(lambda: [each.object_id for each in graph.taken_back if each.status == status], status)
    graph.publish(OBJECT_VIEW, *(make.object_view(20.0 + k, "mug") for k in range(4)))
    assert stamp_s(graph.estimate_of("mug", views=4)) == 23.0


def test_it_leaves_with_zero_whatever_it_does(running: Any, graph: Any, make: Any) -> None:
    graph.publish(OBJECT_VIEW, *(make.object_view(100.0 + k, "mug") for k in range(8)))
    assert running.end() == 0
    assert not running.told("Traceback"), running.log


def test_what_is_destroyed_while_it_is_waited_for_is_no_failure() -> None:
    """rclpy guards most entities against it, but not the events of a subscription."""
    stopping, told = threading.Event(), []

    turns = [InvalidHandle("destruction was requested"), ValueError("a defect")]

    class Executor:
        def spin_once(self) -> None:
            if turns:
                raise turns.pop(0)
            stopping.set()

    class Logger:
        def debug(self, text: str) -> None:
            told.append(("debug", text))

        def error(self, text: str) -> None:
            told.append(("error", text))

    class Node:
        def get_logger(self) -> Logger:
            return Logger()

    scan_node._spin(cast("Any", Executor()), cast("Any", Node()), stopping)
    (gone, defect) = told
    assert gone[0] == "debug"
    assert defect[0] == "error"
    assert "ValueError: a defect" in defect[1]
