from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from relpose_ros.estimates import ObjectPose
from relpose_ros.geometry import so3
from relpose_ros.scanning.outgoing import (
    TYPE_NAMES,
    estimate_message,
    is_weak,
    markers,
    pose_array,
    view_colour,
)
from relpose_ros.views import BoundingBox, Scan, View

if TYPE_CHECKING:
    from collections.abc import Callable

    from relpose_ros.estimates import ScanEstimate

AZIMUTHS = [0.0, 0.5, 2.0]
SPHERE, LINE_LIST, TEXT, DELETE_ALL = 2, 5, 9, 3


@pytest.fixture
def scan() -> Scan:
    pixels = np.zeros((8, 8, 3), np.uint8)
    stamps = [1_000_000_001, 2_500_000_000, 4_000_000_002]
    views = [
        View(pixels, BoundingBox(0, 0, 8, 8), 640, 480, stamp_ns=stamp, frame_id=f"camera_{k}")
        for k, stamp in enumerate(stamps)
    ]
    return Scan("mug", tuple(views))


@pytest.fixture
def estimate(scan: Scan, make_estimate: Callable[..., ScanEstimate]) -> ScanEstimate:
    return make_estimate(scan, AZIMUTHS, ambiguous=True)


def stamp_of(header: Any) -> tuple[int, int]:
    return header.stamp.sec, header.stamp.nanosec


def xyzw(orientation: Any) -> list[float]:
    return [orientation.x, orientation.y, orientation.z, orientation.w]


def xyz(point: Any) -> list[float]:
    return [point.x, point.y, point.z]


def test_where_the_object_is_in_the_robots_frame(messages: Any, scan: Scan, estimate: ScanEstimate) -> None:
    covariance = np.diag(np.arange(1.0, 7.0))
    pose = ObjectPose("base", so3.exp([0.3, 0.2, -0.1]), np.array([0.5, -0.2, 0.9]), covariance)
    metric = replace(estimate, scale_known=True, scale_deviation=0.03, object_pose=pose)
    message = estimate_message(metric, scan, messages.types, "mug_frame")
    assert (message.scale_known, message.scale_deviation) == (True, 0.03)
    told = message.object_pose
    assert (told.header.frame_id, stamp_of(told.header)) == ("base", (4, 2))
    assert xyz(told.pose.pose.position) == [0.5, -0.2, 0.9]
    np.testing.assert_allclose(xyzw(told.pose.pose.orientation), so3.quaternion_xyzw(pose.robot_from_object))
    np.testing.assert_array_equal(np.reshape(told.pose.covariance, (6, 6)), covariance)


def test_an_object_that_nobody_knows_the_place_of(messages: Any, scan: Scan, estimate: ScanEstimate) -> None:
    message = estimate_message(estimate, scan, messages.types, "mug_frame")
    assert message.scale_deviation == 0
    assert message.object_pose.header.frame_id == ""
    assert message.object_pose.pose.covariance[0] == -1
    assert message.object_pose.pose.pose.orientation.w == 1


def test_an_estimate_is_told_in_full(messages: Any, scan: Scan, estimate: ScanEstimate) -> None:
    message = estimate_message(estimate, scan, messages.types, "mug_frame")
    assert message.header.frame_id == "mug_frame"
    assert stamp_of(message.header) == (4, 2), "of the newest view"
    assert message.object_id == "mug"
    assert (message.score, message.seconds, message.status) == (12.5, 0.25, "one more view")
    assert (message.scale_known, message.calibrated) == (False, True)
    assert (message.verdict, message.weakest_pair) == (2, 2)

    assert [camera.view for camera in message.cameras] == [0, 1, 2]
    assert [stamp_of(camera.header) for camera in message.cameras] == [(1, 1), (2, 500_000_000), (4, 2)]
    assert [camera.header.frame_id for camera in message.cameras] == ["camera_0", "camera_1", "camera_2"]
    for told, camera in zip(message.cameras, estimate.cameras, strict=True):
        np.testing.assert_array_equal(xyz(told.pose.pose.position), camera.position)
        quaternion = xyzw(told.pose.pose.orientation)
        np.testing.assert_allclose(
            so3.from_quaternion_xyzw(quaternion), camera.object_from_camera, atol=1e-12
        )
        np.testing.assert_array_equal(np.reshape(told.pose.covariance, (6, 6)), camera.covariance)

    assert [(pair.i, pair.j) for pair in message.pairs] == [(0, 1), (0, 2), (1, 2)]
    for told, pair in zip(message.pairs, estimate.pairs, strict=True):
        assert told.entropy == pair.entropy
        assert told.probability_within_15_deg == pair.probability_within_15_deg
        assert (told.ambiguous, told.ambiguity_angle) == (pair.ambiguous, pair.ambiguity_angle)
        assert (told.solution_probability, told.solution_angle) == (0.8, 0.1)
        assert told.evidence == 1
        np.testing.assert_array_equal(np.reshape(told.covariance, (3, 3)), pair.covariance)
        np.testing.assert_allclose(xyzw(told.orientation), so3.quaternion_xyzw(pair.camera_j_from_camera_i))
        assert [mode.weight for mode in told.modes] == [0.7, 0.3]
        np.testing.assert_array_equal(np.reshape(told.modes[1].covariance, (3, 3)), 2 * np.eye(3))
        np.testing.assert_allclose(
            xyzw(told.modes[1].orientation), so3.quaternion_xyzw(pair.modes[1].camera_j_from_camera_i)
        )


def test_an_untimed_estimate_says_nothing_about_this_machine(
    messages: Any, scan: Scan, estimate: ScanEstimate
) -> None:
    assert estimate_message(estimate, scan, messages.types, "object", timed=False).seconds == 0.0


def test_the_poses_go_out_under_the_same_header(messages: Any, scan: Scan, estimate: ScanEstimate) -> None:
    message = estimate_message(estimate, scan, messages.types, "object")
    poses = pose_array(estimate, scan, messages.types, "object")
    assert poses.header == message.header
    assert poses.poses == [camera.pose.pose for camera in message.cameras]
    assert all(
        marker.header == message.header
        for marker in markers(estimate, scan, messages.types, "object").markers
    )


def test_an_estimate_without_cameras_clears_what_was_shown(
    messages: Any, scan: Scan, estimate: ScanEstimate
) -> None:
    nothing = replace(estimate, cameras=(), pairs=(), weakest_pair=0)
    message = estimate_message(nothing, scan, messages.types, "object")
    assert (len(message.cameras), len(message.pairs)) == (0, 0)
    poses = pose_array(nothing, scan, messages.types, "object")
    assert (poses.header, len(poses.poses)) == (message.header, 0)
    (marker,) = markers(nothing, scan, messages.types, "object").markers
    assert (marker.header, marker.action) == (message.header, DELETE_ALL)


@pytest.mark.parametrize(
    ("build", "name"),
    [
        (estimate_message, "relpose_ros/msg/ScanEstimate"),
        (pose_array, "geometry_msgs/msg/PoseArray"),
        (markers, "visualization_msgs/msg/MarkerArray"),
    ],
)
def test_a_bag_and_the_graph_are_told_the_same(
    graph_messages: Any, bag_messages: Any, scan: Scan, estimate: ScanEstimate, build: Any, name: str
) -> None:
    """Compared after a way through CDR, which rounds colours to 32 bits."""
    from rclpy.serialization import deserialize_message

    live, recorded = (
        deserialize_message(
            messages.serialise(build(estimate, scan, messages.types, "object"), name),
            graph_messages.types[name],
        )
        for messages in (graph_messages, bag_messages)
    )
    assert live == recorded
    assert live != graph_messages.types[name]()


def test_only_the_named_types_are_used(bag_messages: Any, scan: Scan, estimate: ScanEstimate) -> None:
    types = {name: bag_messages.types[name] for name in TYPE_NAMES}
    used = set()

    class Watched(dict[str, Any]):
        def __getitem__(self, name: str) -> Any:
            used.add(name)
            return types[name]

    estimate_message(estimate, scan, Watched(), "object")
    pose_array(estimate, scan, Watched(), "object")
    markers(estimate, scan, Watched(), "object")
    assert used == set(TYPE_NAMES)


def drawn(array: Any, namespace: str) -> list[Any]:
    return [marker for marker in array.markers if marker.ns == namespace and marker.action == 0]


def test_old_markers_vanish_first(messages: Any, scan: Scan, estimate: ScanEstimate) -> None:
    array = markers(estimate, scan, messages.types, "object")
    assert [marker.action for marker in array.markers] == [DELETE_ALL] + [0] * (len(array.markers) - 1)
    names = [(marker.ns, marker.id) for marker in array.markers]
    assert len(set(names)) == len(names), "a viewer takes the last of two with one name"


def test_a_frustum_looks_where_its_camera_looks(messages: Any, scan: Scan, estimate: ScanEstimate) -> None:
    frusta = drawn(markers(estimate, scan, messages.types, "object"), "cameras")
    assert [marker.id for marker in frusta] == [0, 1, 2]
    for marker, camera in zip(frusta, estimate.cameras, strict=True):
        assert marker.type == LINE_LIST
        assert marker.scale.x > 0
        assert len(marker.points) % 2 == 0
        rotation = so3.from_quaternion_xyzw(xyzw(marker.pose.orientation))
        points = np.array([xyz(point) for point in marker.points]) @ rotation.T + xyz(marker.pose.position)
        away = points[np.linalg.norm(points - camera.position, axis=1) > 1e-9]
        # The cameras of this estimate look at the origin from a distance of one.
        assert np.linalg.norm(away, axis=1).max() < 1
        image = np.array([xyz(point) for point in marker.points])
        assert np.ptp(image[:, 0]) > np.ptp(image[image[:, 2] > 0][:8, 1]), "as wide as 640 x 480"
        assert image[:, 1].min() < -image[:, 1].max(), "the roof is above: y points down"


def test_the_colours_run_from_red_to_magenta(messages: Any, scan: Scan, estimate: ScanEstimate) -> None:
    assert view_colour(0) == (1.0, 0.0, 0.0)
    assert view_colour(7) == pytest.approx((1.0, 0.0, 1.0))
    assert len({view_colour(k) for k in range(8)}) == 8
    array = markers(estimate, scan, messages.types, "object")
    for namespace in ("cameras", "indices"):
        for marker in drawn(array, namespace):
            colour = (marker.color.r, marker.color.g, marker.color.b)
            assert colour == pytest.approx(view_colour(marker.id))
            assert marker.color.a == 1.0
    assert [marker.text for marker in drawn(array, "indices")] == ["0", "1", "2"]
    assert all(marker.type == TEXT and marker.scale.z > 0 for marker in drawn(array, "indices"))


def test_an_index_stands_above_its_camera_as_the_image_has_it(
    bag_messages: Any, scan: Scan, estimate: ScanEstimate
) -> None:
    """Also above one that is rolled; y points down."""
    rolled = replace(estimate.cameras[1], object_from_camera=so3.exp([0.0, 0.0, 1.0]))
    cameras = (estimate.cameras[0], rolled, estimate.cameras[2])
    array = markers(replace(estimate, cameras=cameras), scan, bag_messages.types, "object")
    for marker, camera in zip(drawn(array, "indices"), cameras, strict=True):
        above = (xyz(marker.pose.position) - camera.position) @ camera.object_from_camera
        assert above[1] < 0
        np.testing.assert_allclose(above[[0, 2]], 0, atol=1e-12)


def test_the_object_is_at_the_origin(messages: Any, scan: Scan, estimate: ScanEstimate) -> None:
    *axes, sphere = drawn(markers(estimate, scan, messages.types, "object"), "object")
    assert sphere.type == SPHERE
    assert xyz(sphere.pose.position) == [0.0, 0.0, 0.0]
    for k, axis in enumerate(axes):
        tip = np.array(xyz(axis.points[1]))
        assert xyz(axis.points[0]) == [0.0, 0.0, 0.0]
        assert np.argmax(tip) == k
        assert [axis.color.r, axis.color.g, axis.color.b] == list(np.eye(3)[k])


def test_weak_pairs_are_joined_by_a_line_that_says_why(
    messages: Any, scan: Scan, estimate: ScanEstimate, make_estimate: Callable[..., ScanEstimate]
) -> None:
    array = markers(estimate, scan, messages.types, "object")
    (line,), (text,) = drawn(array, "weak_pairs"), drawn(array, "weak_pair_reasons")
    np.testing.assert_allclose(xyz(line.points[0]), estimate.cameras[0].position)
    np.testing.assert_allclose(xyz(line.points[1]), estimate.cameras[1].position)
    assert text.text == "0-1: ambiguous by 180 deg"
    certain = make_estimate(scan, AZIMUTHS)
    assert not any(is_weak(pair) for pair in certain.pairs)
    assert drawn(markers(certain, scan, messages.types, "object"), "weak_pairs") == []


def test_an_uncertain_pair_is_weak_too(
    bag_messages: Any, scan: Scan, make_estimate: Callable[..., ScanEstimate]
) -> None:
    certain = make_estimate(scan, AZIMUTHS)
    pairs = (*certain.pairs[:2], replace(certain.pairs[2], probability_within_15_deg=0.234))
    array = markers(replace(certain, pairs=pairs), scan, bag_messages.types, "object")
    assert [marker.text for marker in drawn(array, "weak_pair_reasons")] == ["1-2: 23 % sure"]


def test_cameras_at_the_origin_are_still_drawn(
    messages: Any, scan: Scan, make_estimate: Callable[..., ScanEstimate]
) -> None:
    estimate = make_estimate(scan, AZIMUTHS)
    for camera in estimate.cameras:
        camera.position[:] = 0.0
    for marker in markers(estimate, scan, messages.types, "object").markers:
        assert marker.type != LINE_LIST or marker.scale.x > 0
