from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from relpose_ros.estimates import CameraPose, ScanEstimate, Verdict
from relpose_ros.geometry import so3
from relpose_ros.replay.comparison import TruePose, compare

if TYPE_CHECKING:
    from relpose_ros.estimates import FloatArray


def turn_z(degrees: float) -> FloatArray:
    return so3.exp([0, 0, np.radians(degrees)])


def estimate_of(poses: list[tuple[FloatArray, FloatArray]]) -> ScanEstimate:
    cameras = tuple(CameraPose(k, rotation, centre, np.eye(6)) for k, (rotation, centre) in enumerate(poses))
    return ScanEstimate("mug", cameras, (), 0.0, False, False, Verdict.ENOUGH, 0, "enough", 0.0)


STAMPS = [10, 20, 30, 40]
TRUTH = {
    10: TruePose(turn_z(0), np.array([1.0, 0, 0])),
    20: TruePose(turn_z(90), np.array([0.0, 1, 0])),
    30: TruePose(turn_z(180), np.array([-1.0, 0, 0])),
    40: TruePose(turn_z(270), np.array([0.0, -1, 0])),
}


def moved(scale: float, rotation: FloatArray, shift: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """The truth in another frame and unit."""
    return [
        (rotation @ pose.world_from_camera, scale * rotation @ pose.centre + shift) for pose in TRUTH.values()
    ]


def test_errors_by_hand() -> None:
    """Camera 1 is turned 20 degrees too far; camera 3 stands 0.5 too far out, before alignment."""
    poses = moved(1.0, np.eye(3), np.zeros(3))
    poses[1] = (turn_z(110), poses[1][1])
    comparison = compare(estimate_of(poses), STAMPS, TRUTH)
    assert comparison is not None
    assert comparison.rotation_errors == pytest.approx(
        {(0, 1): 20, (0, 2): 0, (0, 3): 0, (1, 2): 20, (1, 3): 20, (2, 3): 0}, abs=1e-6
    )
    assert comparison.centre_errors == pytest.approx(dict.fromkeys(range(4), 0.0), abs=1e-9)


def test_centre_errors_by_hand() -> None:
    """Two opposite cameras at 1.5 and two at 0.5: the best scale is (1.5 + 0.5) / (1.5^2 + 0.5^2) = 0.8."""
    poses = moved(1.0, np.eye(3), np.zeros(3))
    poses = [(rotation, centre * (1.5 if k % 2 else 0.5)) for k, (rotation, centre) in enumerate(poses)]
    comparison = compare(estimate_of(poses), STAMPS, TRUTH)
    assert comparison is not None
    assert comparison.centre_errors == pytest.approx({0: 0.6, 1: 0.2, 2: 0.6, 3: 0.2})


def test_scale_and_frame_do_not_matter_and_the_truth_is_shown_where_it_belongs() -> None:
    rotation, shift = so3.exp([0.3, -0.8, 1.1]), np.array([4.0, 5, 6])
    poses = moved(0.2, rotation, shift)
    comparison = compare(estimate_of(poses), STAMPS, TRUTH)
    assert comparison is not None
    assert max(comparison.rotation_errors.values()) < 1e-5
    assert comparison.centre_errors is not None
    assert max(comparison.centre_errors.values()) < 1e-9
    for k, (object_from_camera, position) in enumerate(poses):
        np.testing.assert_allclose(comparison.aligned[k].world_from_camera, object_from_camera, atol=1e-9)
        np.testing.assert_allclose(comparison.aligned[k].centre, position, atol=1e-9)


def test_two_cameras_have_no_centre_errors() -> None:
    rotation = so3.exp([0.3, -0.8, 1.1])
    poses = moved(0.2, rotation, np.array([1.0, 0, 0]))[:2]
    comparison = compare(estimate_of(poses), STAMPS[:2], TRUTH)
    assert comparison is not None
    assert comparison.centre_errors is None
    np.testing.assert_allclose(comparison.aligned[1].centre, poses[1][1], atol=1e-9)
    np.testing.assert_allclose(comparison.aligned[1].world_from_camera, poses[1][0], atol=1e-9)


def test_views_without_truth_take_no_part() -> None:
    poses = moved(1.0, np.eye(3), np.zeros(3))
    comparison = compare(estimate_of(poses), [10, 99, 30, 40], TRUTH)
    assert comparison is not None
    assert set(comparison.rotation_errors) == {(0, 2), (0, 3), (2, 3)}
    assert set(comparison.aligned) == {0, 2, 3}
    assert compare(estimate_of(poses), [10, 97, 98, 99], TRUTH) is None


def test_coincident_estimates_cannot_be_aligned() -> None:
    poses = [(turn_z(90 * k), np.zeros(3)) for k in range(4)]
    comparison = compare(estimate_of(poses), STAMPS, TRUTH)
    assert comparison is not None
    assert comparison.aligned == {}
    assert comparison.centre_errors == pytest.approx(dict.fromkeys(range(4), 1.0))
