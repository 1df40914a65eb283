"""Where a robot says its cameras stood, held against where they were found: metres, and the robot's frame.

A similarity takes the object frame to the robot's: scale s, rotation Q and shift d are those by which
estimated and known poses agree best. The scale rests on the baselines between cameras, so that the robot's
frame may lie anywhere and turned in any way.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.estimates import ObjectPose
from relpose_ros.geometry import so3
from relpose_ros.inference.camera_positions import apart, rows_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy.typing as npt

    from relpose_ros.views import RobotPose

    FloatArray = npt.NDArray[np.float64]

LARGEST_SCALE_DEVIATION = 0.15
"""Of the scale, relative: above it the baselines are too short against their uncertainty to mean much."""
LARGEST_MISFIT = 4.0
"""Squared deviations relative to what the covariances say, a degree of freedom: from here on poses contradict
each other, since twice the stated deviation on average is no chance."""
UNKNOWN = math.radians(20)
"""Standard deviation of a camera's rotation, worst axis, from which on its estimate takes no part: how far
such turns move a camera is not linear, and it could tell little."""
ROUNDS = 5
"""Of Gauss and Newton; from the closed form two are enough."""
UNKNOWNS = 7


@dataclass(frozen=True, eq=False)
class RobotFrame:
    """How the object frame lies in the robot's."""

    scale: float
    """Metres per unit of the estimate."""
    deviation: float
    """Standard deviation of the scale, relative to it."""
    object_pose: ObjectPose


@dataclass(frozen=True, eq=False)
class _Fit:
    scale: float
    rotation: FloatArray
    """(3, 3) robot_from_object."""
    shift: FloatArray
    """(3,) the object frame's origin in the robot's frame."""
    covariance: FloatArray
    """(7, 7) of log scale, rotation (left perturbation) and shift."""
    misfit: float
    """Squared deviations a degree of freedom; about 1 where the covariances hold."""


def find_robot_frame(
    rotations: FloatArray, centres: FloatArray, covariance: FloatArray, poses: Sequence[RobotPose | None]
) -> RobotFrame | str:
    """The similarity from the object frame to the robot's, or why there is none.

    All poses count if they agree. Where they do not, as few as possible are left out, a minority at most: one
    wrong pose, of the robot's or of the estimate's, spoils nothing from the third camera on.

    Args:
        rotations: (N, 3, 3) camera_from_object.
        centres: (N, 3) camera centres in the object frame, any unit.
        covariance: (6 N, 6 N) joint one: for each camera x, y, z and the rotation about X, Y, Z, fixed axes
            of the object frame.
        poses: of the N cameras; those of the frame that most are in count.

    Returns:
        The frame, or the reason why the scale is not known as the end of a sentence.
    """
    frames = Counter(pose.frame_id for pose in poses if pose is not None)
    if not frames:
        return "no camera pose of the robot is known"
    frame = frames.most_common(1)[0][0]
    told = [k for k, pose in enumerate(poses) if pose is not None and pose.frame_id == frame]
    if len(told) < 2:
        return "the camera pose of one view alone is known in the robot's frame"
    turns = apart(covariance)[:, 3:, 3:]
    cameras = [k for k in told if np.linalg.eigvalsh(turns[k])[-1] < UNKNOWN**2]
    if len(cameras) < 2:
        return "of the views whose camera pose is known, less than two are tied to the others"
    problem = _Problem(rotations, centres, covariance, poses)
    for chosen in _majorities(cameras):
        fits = [fit for subset in chosen if (fit := problem.fit(subset)) is not None]
        agreeing = [fit for fit in fits if fit.misfit < LARGEST_MISFIT]
        if agreeing:
            return _told(min(agreeing, key=lambda fit: fit.misfit), frame)
    if _in_one_place([pose for k in cameras if (pose := poses[k]) is not None]):
        return "the camera stood in one place, as far as the robot's camera poses tell"
    return "the robot's camera poses contradict the ones that were found"


def _in_one_place(poses: Sequence[RobotPose]) -> bool:
    """Whether the positions differ by no more than their deviations, as of a camera before a turntable."""
    positions = np.stack([pose.position for pose in poses])
    apart_by = np.square(positions - positions.mean(0)).sum()
    return bool(apart_by <= sum(np.trace(pose.covariance[:3, :3]) for pose in poses))


def _majorities(cameras: Sequence[int]) -> Iterator[list[tuple[int, ...]]]:
    """All cameras, then all but one in every way, and so on down to the smallest majority."""
    for size in range(len(cameras), max(1, len(cameras) // 2), -1):
        yield list(itertools.combinations(cameras, size))


def _told(fit: _Fit, frame: str) -> RobotFrame | str:
    deviation = math.sqrt(fit.covariance[0, 0])
    if deviation > LARGEST_SCALE_DEVIATION:
        return f"the baselines tell it to {100 * min(deviation, 1):.0f}% only"
    order = [4, 5, 6, 1, 2, 3]  # position first, as geometry_msgs/PoseWithCovariance has it
    pose = ObjectPose(frame, fit.rotation, fit.shift, fit.covariance[np.ix_(order, order)])
    return RobotFrame(fit.scale, deviation, pose)


class _Problem:
    """Estimated and known poses of the same cameras."""

    def __init__(
        self,
        rotations: FloatArray,
        centres: FloatArray,
        covariance: FloatArray,
        poses: Sequence[RobotPose | None],
    ) -> None:
        self._rotations, self._centres = rotations, centres
        self._covariance, self._poses = covariance, poses

    def fit(self, cameras: Sequence[int]) -> _Fit | None:
        """Least squares over some cameras; None where they all stand in one place."""
        known = [pose for k in cameras if (pose := self._poses[k]) is not None]
        found, centres = self._rotations[list(cameras)], self._centres[list(cameras)]
        turned = np.stack([pose.robot_from_camera for pose in known])
        wanted = np.stack([pose.position for pose in known])
        lengths = [float(np.linalg.norm(each - each.mean(0))) for each in (centres, wanted)]
        if min(lengths) < 1e-9:
            return None
        rotation = so3.project(np.einsum("nab,nbc->ac", turned, found))
        scale = lengths[1] / lengths[0]
        shift = (wanted - scale * centres @ rotation.T).mean(0)
        rows = rows_of(cameras)
        spread = self._covariance[np.ix_(rows, rows)]
        stated = np.zeros_like(spread)
        for slot, pose in enumerate(known):
            stated[6 * slot : 6 * slot + 6, 6 * slot : 6 * slot + 6] = pose.covariance
        for _ in range(ROUNDS):
            placed = scale * centres @ rotation.T
            turns = so3.log(np.einsum("nab,nbc,dc->nad", turned, found, rotation))
            residuals = np.concatenate([wanted - placed - shift, turns], 1).reshape(-1)
            into = np.kron(np.eye(2 * len(cameras)), rotation)
            into[np.arange(len(into)) % 6 < 3] *= scale
            information = np.linalg.inv(into @ spread @ into.T + stated)
            jacobian = _jacobian(placed)
            normal = jacobian.T @ information @ jacobian
            step = np.linalg.solve(normal, jacobian.T @ information @ residuals)
            scale *= math.exp(float(np.clip(step[0], -1, 1)))
            rotation = so3.exp(step[1:4]) @ rotation
            shift = shift + step[4:]
        left = residuals - jacobian @ step
        freedom = len(residuals) - UNKNOWNS
        misfit = float(left @ information @ left) / freedom
        return _Fit(scale, rotation, shift, np.linalg.inv(normal) * max(1.0, misfit), misfit)


def _jacobian(placed: FloatArray) -> FloatArray:
    """Of every camera's position and rotation by log scale, turn and shift. (K, 3) -> (6 K, 7)."""
    jacobian = np.zeros((len(placed), 6, UNKNOWNS))
    jacobian[:, :3, 0] = placed
    jacobian[:, :3, 1:4] = -so3.hat(placed)
    jacobian[:, :3, 4:] = jacobian[:, 3:, 1:4] = np.eye(3)
    return jacobian.reshape(-1, UNKNOWNS)
