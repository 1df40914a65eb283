from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from relpose_ros.scanning import robot_poses
from relpose_ros.scanning.incoming import Source
from relpose_ros.scanning.robot_poses import RobotPoses
from relpose_ros.views import BoundingBox, RobotPose, View


def pose(x: float = 0.0) -> RobotPose:
    return RobotPose("base", np.eye(3), np.array([x, 0.0, 0.0]), np.eye(6))


def view(stamp_ns: int, frame_id: str = "camera") -> View:
    return View(
        np.zeros((8, 8, 3), np.uint8), BoundingBox(0, 0, 8, 8), 8, 8, stamp_ns=stamp_ns, frame_id=frame_id
    )


def put(poses: RobotPoses, stamp_ns: int, x: float = 0.0, held: Any = ()) -> tuple[bool, list[int]]:
    news, gone = poses.put(Source("camera_pose", stamp_ns, "base"), pose(x), held)
    return news, [source.stamp_ns for source in gone]


def test_each_view_has_the_pose_of_its_stamp() -> None:
    poses = RobotPoses()
    for stamp in (1, 2, 3):
        assert put(poses, stamp, float(stamp)) == (True, [])
    found = poses.of([view(3), view(9), view(1)])
    assert [None if each is None else each.position[0] for each in found] == [3.0, None, 1.0]


def test_a_pose_with_a_covariance_stays_where_one_without_comes() -> None:
    source, stated, plain = Source("camera_pose", 1, "base"), pose(1.0), replace(pose(2.0), stated=False)
    for order, news in (((stated, plain), False), ((plain, stated), True)):
        poses = RobotPoses()
        assert poses.put(source, order[0], ())[0]
        assert poses.put(source, order[1], ())[0] is news
        assert poses.of([view(1)]) == (stated,)


def test_the_poses_of_views_that_nobody_needs_are_no_strays() -> None:
    """As of a full scan that keeps its first views, with a pose for each picture, before it or after it."""
    poses = RobotPoses()
    for stamp in range(3 * robot_poses.KEPT):
        if stamp % 2:
            poses.pass_over(stamp)
        assert put(poses, stamp) == (True, [])
        poses.pass_over(stamp)
    assert len(poses._passed_over) <= robot_poses.KEPT
    strays = [put(poses, stamp)[1] for stamp in range(10_000, 10_000 + robot_poses.KEPT + 1)]
    assert strays[-1] == [10_000]


def test_no_pose_at_all_is_nothing() -> None:
    poses = RobotPoses()
    put(poses, 1)
    assert poses.of([view(2), view(3)]) == ()


def test_cameras_of_one_stamp_have_none() -> None:
    poses = RobotPoses()
    put(poses, 1)
    put(poses, 2)
    found = poses.of([view(1, "left"), view(1, "right"), view(2, "left")])
    assert [each is not None for each in found] == [False, False, True]


def test_a_pose_that_comes_again_is_no_news_and_another_one_is() -> None:
    poses = RobotPoses()
    assert put(poses, 1, 0.5) == (True, [])
    assert put(poses, 1, 0.5) == (False, [])
    assert put(poses, 1, 0.6) == (True, [])
    (found,) = poses.of([view(1)])
    assert found is not None
    assert found.position[0] == 0.6


def test_the_same_numbers_in_another_frame_or_with_another_spread_are_news() -> None:
    poses = RobotPoses()
    source = Source("camera_pose", 1, "base")
    turned = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    told = [
        pose(),
        replace(pose(), frame_id="map"),
        replace(pose(), robot_from_camera=turned),
        replace(pose(), covariance=2 * np.eye(6)),
    ]
    assert [poses.put(source, each, ())[0] for each in told] == [True] * 4


def test_a_pose_is_claimed_once() -> None:
    poses = RobotPoses()
    put(poses, 1)
    assert poses.claim(2) is None
    assert poses.claim(1) == Source("camera_pose", 1, "base")
    assert poses.claim(1) is None
    assert put(poses, 1, 0.5) == (True, [])
    assert poses.claim(1) is None, "the view has it already, if with other numbers"


def test_the_oldest_goes_unless_its_view_is_held(monkeypatch: Any) -> None:
    monkeypatch.setattr(robot_poses, "KEPT", 2)
    poses = RobotPoses()
    put(poses, 1)
    put(poses, 2)
    poses.claim(2)
    assert put(poses, 3, held={1}) == (True, [])
    assert put(poses, 4, held={1}) == (True, []), "the second was a view's, which is gone by now"
    assert put(poses, 5, held={1}) == (True, [3]), "nobody ever asked for the third"
    assert [each is not None for each in poses.of([view(k) for k in range(1, 6)])] == [
        *(True, False, False, True, True)
    ]


def test_all_but_those_of_views_held_are_forgotten() -> None:
    poses = RobotPoses()
    put(poses, 1)
    put(poses, 2)
    poses.forget({2})
    assert [each is not None for each in poses.of([view(1), view(2)])] == [False, True]
