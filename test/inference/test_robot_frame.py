from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.geometry import cameras, so3
from relpose_ros.inference.camera_positions import joined
from relpose_ros.inference.robot_frame import LARGEST_SCALE_DEVIATION, RobotFrame, find_robot_frame
from relpose_ros.views import RobotPose

METRES = 0.4
"""Of the unit of the estimates here."""
ARM = np.diag([0.002**2] * 3 + [0.005**2] * 3)


def around(count, seed, radius=1.0):
    """camera_from_object and centres of cameras that look at the origin."""
    generator = np.random.default_rng(seed)
    centres = generator.standard_normal((count, 3))
    centres *= radius / np.linalg.norm(centres, axis=1, keepdims=True)
    return cameras.look_at(centres, np.zeros(3)), centres


def told(rotations, centres, robot_from_object=None, shift=(0.5, -0.2, 0.9), covariance=ARM, frame="base"):
    """What a robot that knows everything says of these cameras."""
    turn = so3.exp([0.3, -0.8, 1.9]) if robot_from_object is None else robot_from_object
    return [
        RobotPose(frame, turn @ rotation.T, METRES * turn @ centre + np.asarray(shift), covariance)
        for rotation, centre in zip(rotations, centres, strict=True)
    ]


def spread(count, position=0.01, rotation=0.01):
    return joined(np.tile(np.diag([position**2] * 3 + [rotation**2] * 3), (count, 1, 1)))


@pytest.mark.parametrize("count", [2, 3, 8])
def test_exact_poses_give_scale_and_pose_of_the_object(count):
    rotations, centres = around(count, count)
    turn = so3.exp([0.3, -0.8, 1.9])
    found = find_robot_frame(rotations, centres, spread(count), told(rotations, centres))
    assert found.scale == pytest.approx(METRES)
    assert 0 < found.deviation < 0.02
    np.testing.assert_allclose(found.object_pose.robot_from_object, turn, atol=1e-9)
    np.testing.assert_allclose(found.object_pose.position, [0.5, -0.2, 0.9], atol=1e-9)
    assert found.object_pose.frame_id == "base"
    assert np.linalg.eigvalsh(found.object_pose.covariance).min() > 0


def noisy(count, seed, position=0.02, rotation=0.02):
    """An estimate and a robot that err as their covariances say."""
    generator = np.random.default_rng([seed, 7])
    rotations, centres = around(count, seed)
    poses = told(rotations, centres)
    poses = [
        RobotPose(
            pose.frame_id,
            so3.exp(generator.normal(0, 0.005, 3)) @ pose.robot_from_camera,
            pose.position + generator.normal(0, 0.002, 3),
            pose.covariance,
        )
        for pose in poses
    ]
    turns = generator.normal(0, rotation, (count, 3))
    estimated = rotations @ so3.exp(-turns)
    return estimated, centres + generator.normal(0, position, (count, 3)), poses


def test_errors_are_as_large_as_stated():
    scales, squares = [], []
    for seed in range(60):
        rotations, centres, poses = noisy(4, seed)
        found = find_robot_frame(rotations, centres, spread(4, 0.02, 0.02), poses)
        scales.append(math.log(found.scale / METRES) / found.deviation)
        turn = so3.log(so3.exp([0.3, -0.8, 1.9]) @ found.object_pose.robot_from_object.T)
        error = np.concatenate([np.array([0.5, -0.2, 0.9]) - found.object_pose.position, turn])
        squares.append(error @ np.linalg.solve(found.object_pose.covariance, error))
    assert 0.5 < np.mean(np.square(scales)) < 1.5
    assert 4 < np.mean(squares) < 9


@settings(max_examples=25, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-10, 10)] * 3),
    seed=st.integers(0, 9),
)
def test_where_the_robot_has_its_frame_does_not_matter(turn, shift, seed):
    rotations, centres, poses = noisy(4, seed)
    moved_from_robot = so3.exp(turn)
    both = np.kron(np.eye(2), moved_from_robot)
    elsewhere = [
        RobotPose(
            "map",
            moved_from_robot @ pose.robot_from_camera,
            moved_from_robot @ pose.position + shift,
            both @ pose.covariance @ both.T,
        )
        for pose in poses
    ]
    here = find_robot_frame(rotations, centres, spread(4, 0.02, 0.02), poses)
    there = find_robot_frame(rotations, centres, spread(4, 0.02, 0.02), elsewhere)
    assert there.scale == pytest.approx(here.scale, rel=1e-6)
    assert there.deviation == pytest.approx(here.deviation, rel=1e-6)
    np.testing.assert_allclose(
        there.object_pose.robot_from_object,
        moved_from_robot @ here.object_pose.robot_from_object,
        atol=1e-6,
    )
    np.testing.assert_allclose(
        there.object_pose.position, moved_from_robot @ here.object_pose.position + shift, atol=1e-6
    )
    np.testing.assert_allclose(
        there.object_pose.covariance, both @ here.object_pose.covariance @ both.T, atol=1e-9
    )


@settings(max_examples=25, deadline=None)
@given(unit=st.floats(0.01, 100), seed=st.integers(0, 9))
def test_the_unit_of_the_estimate_does_not_matter(unit, seed):
    rotations, centres, poses = noisy(4, seed)
    covariance = spread(4, 0.02, 0.02)
    units = np.tile(np.repeat([unit, 1.0], 3), 4)
    here = find_robot_frame(rotations, centres, covariance, poses)
    there = find_robot_frame(rotations, unit * centres, units[:, None] * covariance * units, poses)
    assert unit * there.scale == pytest.approx(here.scale, rel=1e-6)
    assert there.deviation == pytest.approx(here.deviation, rel=1e-6)


@pytest.mark.parametrize("count", [3, 4, 8])
@pytest.mark.parametrize("wrong", ["position", "rotation", "estimate"])
def test_one_wrong_pose_is_outvoted(count, wrong):
    rotations, centres, poses = noisy(count, 3)
    if wrong == "estimate":
        rotations[1], centres[1] = so3.exp([0, 1.5, 0]) @ rotations[1], -centres[1]
    else:
        old = poses[1]
        shift = np.array([0.3, 0, 0]) if wrong == "position" else np.zeros(3)
        turn = so3.exp([0, 0, 0.7]) if wrong == "rotation" else np.eye(3)
        poses[1] = RobotPose("base", turn @ old.robot_from_camera, old.position + shift, ARM)
    found = find_robot_frame(rotations, centres, spread(count, 0.02, 0.02), poses)
    assert abs(math.log(found.scale / METRES)) < 3 * found.deviation
    assert found.deviation < 0.1


def test_two_that_agree_are_no_majority_of_four():
    """Any two poses agree on some scale, when their positions alone are wrong along the line between them."""
    rotations, centres, poses = noisy(4, 3)
    for camera, shift in ((1, [0.4, 0, 0]), (2, [0, 0.5, 0.3])):
        old = poses[camera]
        poses[camera] = RobotPose("base", old.robot_from_camera, old.position + shift, ARM)
    found = find_robot_frame(rotations, centres, spread(4, 0.02, 0.02), poses)
    assert found == "the robot's camera poses contradict the ones that were found"


def test_of_the_majorities_that_agree_the_best_counts():
    """A wrong pose that is not too far off goes together with some of the others."""
    rotations, centres = around(4, 5)
    poses = told(rotations, centres)
    old = poses[1]
    poses[1] = RobotPose("base", old.robot_from_camera, old.position + np.array([0.12, 0, 0]), ARM)
    found = find_robot_frame(rotations, centres, spread(4, 0.02, 0.02), poses)
    assert found.scale == pytest.approx(METRES, rel=1e-6)


def test_errors_larger_than_stated_make_the_scale_as_uncertain_as_they_are():
    """Up to twice as large, from where on the poses contradict each other."""
    scales = []
    for seed in range(60):
        rotations, centres, poses = noisy(8, seed, 0.035, 0.035)
        found = find_robot_frame(rotations, centres, spread(8, 0.02, 0.02), poses)
        scales.append(math.log(found.scale / METRES) / found.deviation)
    assert 0.5 < np.mean(np.square(scales)) < 1.7


def test_poses_that_contradict_each_other_tell_nothing():
    """As where the robot gives the camera's body instead of its optical frame."""
    rotations, centres, poses = noisy(4, 5)
    optical_from_body = so3.exp([0, math.pi / 2, 0]) @ so3.exp([0.4, 0, 0])
    poses = [RobotPose("base", p.robot_from_camera @ optical_from_body, p.position, ARM) for p in poses]
    assert find_robot_frame(rotations, centres, spread(4, 0.02, 0.02), poses) == (
        "the robot's camera poses contradict the ones that were found"
    )


@pytest.mark.parametrize("jitter", [0.0, 0.001])
def test_a_camera_that_the_robot_held_still_tells_no_scale(jitter):
    """As before a turntable: nothing contradicts anything."""
    rotations, centres = around(4, 5)
    offsets = jitter * np.random.default_rng(0).standard_normal((4, 3))
    poses = [RobotPose("base", np.eye(3), np.array([0.1, 0.2, 0.3]) + offset, ARM) for offset in offsets]
    assert find_robot_frame(rotations, centres, spread(4), poses) == (
        "the camera stood in one place, as far as the robot's camera poses tell"
    )


def test_baselines_too_short_against_their_uncertainty():
    rotations, centres = around(3, 1)
    near = [0, 0, -1] + 0.02 * centres
    found = find_robot_frame(rotations, near, spread(3, 0.05), told(rotations, near))
    assert found.startswith("the baselines tell it to ")
    long = find_robot_frame(rotations, centres, spread(3, 0.05), told(rotations, centres))
    assert isinstance(long, RobotFrame)
    assert long.deviation < LARGEST_SCALE_DEVIATION


def test_the_deviation_falls_with_longer_baselines():
    deviations = []
    for radius in (0.5, 1.0, 2.0):
        rotations, centres = around(4, 2, radius)
        deviations.append(find_robot_frame(rotations, centres, spread(4), told(rotations, centres)).deviation)
    assert deviations == sorted(deviations, reverse=True)
    assert deviations[2] == pytest.approx(deviations[0] / 4, rel=0.2)


def test_errors_that_cameras_share_do_not_make_their_baselines_uncertain():
    rotations, centres = around(4, 6)
    shared = np.kron(np.ones((4, 4)), np.diag([0.2**2] * 3 + [0.0] * 3))
    apart = joined(np.tile(np.diag([0.2**2] * 3 + [0.0] * 3), (4, 1, 1)))
    poses = told(rotations, centres)
    together = find_robot_frame(rotations, centres, spread(4) + shared, poses)
    alone = find_robot_frame(rotations, centres, spread(4) + apart, poses)
    assert together.deviation < 0.02
    assert isinstance(alone, str) or alone.deviation > 5 * together.deviation


def test_views_without_a_pose_and_poses_in_another_frame_are_left_out():
    rotations, centres = around(4, 4)
    poses = told(rotations, centres)
    odd = told(rotations, centres, shift=(9, 9, 9), frame="odom")
    found = find_robot_frame(rotations, centres, spread(4), [poses[0], None, poses[2], odd[3]])
    assert found.scale == pytest.approx(METRES)
    assert found.object_pose.frame_id == "base"


def test_a_camera_whose_own_pose_nobody_knows_takes_no_part():
    rotations, centres, poses = noisy(4, 8)
    covariance = spread(4, 0.02, 0.02)
    covariance[6:12, 6:12] = np.diag([1.0] * 3 + [math.radians(60) ** 2] * 3)
    known = find_robot_frame(rotations, centres, covariance, poses)
    rotations[1], centres[1] = so3.exp([0, 2.5, 0]) @ rotations[1], -centres[1]
    wrong = find_robot_frame(rotations, centres, covariance, poses)
    assert (wrong.scale, wrong.deviation) == (known.scale, known.deviation)
    pair = find_robot_frame(rotations, centres, covariance, [*poses[:2], None, None])
    assert pair == "of the views whose camera pose is known, less than two are tied to the others"


def test_a_camera_that_may_be_turned_about_one_axis_takes_no_part():
    rotations, centres, poses = noisy(3, 8)
    covariance = spread(3, 0.02, 0.02)
    covariance[10, 10] = math.radians(60) ** 2
    pair = find_robot_frame(rotations, centres, covariance, [*poses[:2], None])
    assert pair == "of the views whose camera pose is known, less than two are tied to the others"


@pytest.mark.parametrize(
    ("known", "reason"),
    [
        ([], "no camera pose of the robot is known"),
        ([1], "the camera pose of one view alone is known in the"),
    ],
)
def test_too_few_poses(known, reason):
    rotations, centres = around(3, 4)
    poses = [pose if k in known else None for k, pose in enumerate(told(rotations, centres))]
    assert find_robot_frame(rotations, centres, spread(3), poses).startswith(reason)


def test_a_robot_that_never_moved_tells_nothing():
    rotations, centres = around(3, 4)
    still = [RobotPose("base", np.eye(3), np.ones(3), ARM)] * 3
    assert isinstance(find_robot_frame(rotations, centres, spread(3), still), str)
