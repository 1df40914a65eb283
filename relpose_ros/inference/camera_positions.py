"""Where the cameras stand: what the network says of each, and the directions between them, by matches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]
    IntArray = npt.NDArray[np.int64]

ROUNDS = 8
"""Of reweighting: a direction's weight depends on the cameras' distance and on how well it fits."""
LEAST_BASELINE = 0.05
"""In the scan's unit: below it the direction between two cameras means nothing."""


@dataclass(frozen=True, eq=False)
class Baseline:
    """The direction from one camera to another, as a pair's matches have it."""

    i: int
    j: int
    direction: FloatArray
    """(3,) unit vector from camera i's centre to camera j's, in the object frame."""
    covariance: FloatArray
    """(3, 3) of ``direction``, in the object frame."""


def baseline(
    i: int,
    j: int,
    camera_from_object: FloatArray,
    direction: FloatArray,
    covariance: FloatArray,
    rotation_covariance: FloatArray,
) -> Baseline:
    """From a relative pose's translation.

    Args:
        i: A view.
        j: Another.
        camera_from_object: (3, 3) rotation of camera j.
        direction: (3,) unit translation of camera_j_from_camera_i: where camera i stands, seen from j.
        covariance: (3, 3) of it.
        rotation_covariance: (3, 3) of camera j, in the object frame, rad^2: it turns the direction too.
    """
    towards = -camera_from_object.T @ direction
    across = np.eye(3) - np.outer(towards, towards)
    swing = np.trace(across @ rotation_covariance) / 2 * across
    return Baseline(i, j, towards, camera_from_object.T @ covariance @ camera_from_object + swing)


def joined(covariances: FloatArray) -> FloatArray:
    """The joint covariance of cameras that err each for themselves. (N, 6, 6) -> (6 N, 6 N)."""
    joint = np.zeros((len(covariances), 6, len(covariances), 6))
    cameras = np.arange(len(covariances))
    joint[cameras, :, cameras] = covariances
    return joint.reshape(6 * len(covariances), -1)


def apart(joint: FloatArray) -> FloatArray:
    """Each camera's own covariance out of the joint one. (6 N, 6 N) -> (N, 6, 6)."""
    cameras = np.arange(len(joint) // 6)
    return np.asarray(joint.reshape(len(cameras), 6, len(cameras), 6)[cameras, :, cameras])


def rows_of(cameras: Sequence[int], count: int = 6) -> IntArray:
    """Where the first ``count`` numbers of some cameras stand in a joint covariance. -> (count K,)."""
    return (6 * np.asarray(cameras, int)[:, None] + np.arange(count)).reshape(-1)


def place(
    centres: FloatArray, joint: FloatArray, baselines: Sequence[Baseline]
) -> tuple[FloatArray, FloatArray]:
    """The centres that suit both what was known of each and the directions between them.

    Linear least squares on the part of each difference of centres that is across its direction, reweighted by
    distance and, as Cauchy's loss has it, by how well it fits. What the covariance says of the rotations
    follows from how they go along with the positions.

    Args:
        centres: (N, 3) known before, object frame.
        joint: (6 N, 6 N) covariance of position and rotation, for each camera as
            `relpose_ros.estimates.CameraPose` has it.
        baselines: May be few, or contradict each other.

    Returns:
        (N, 3) and (6 N, 6 N).
    """
    if not baselines:
        return centres, joint
    rows = rows_of(range(len(centres)), 3)
    prior = np.linalg.inv(joint[np.ix_(rows, rows)])
    target = prior @ centres.reshape(-1)
    found = centres
    for _ in range(ROUNDS):
        information = prior.copy()
        for each in baselines:
            information += _information(each, found)
        found = np.linalg.solve(information, target).reshape(-1, 3)
    gain = joint[:, rows] @ prior
    updated = joint + gain @ (np.linalg.inv(information) - joint[np.ix_(rows, rows)]) @ gain.T
    return found, (updated + updated.T) / 2


def _information(each: Baseline, centres: FloatArray) -> FloatArray:
    """Of one direction on all centres. -> (3 N, 3 N)."""
    difference = centres[each.j] - centres[each.i]
    length = max(float(np.linalg.norm(difference)), LEAST_BASELINE)
    across = np.eye(3) - np.outer(each.direction, each.direction)
    # Along the direction the covariance is zero: any value there serves, since `across` leaves it out.
    weight = (
        across
        @ np.linalg.inv(length**2 * each.covariance + length**2 * np.outer(each.direction, each.direction))
        @ across
    )
    misfit = float(difference @ weight @ difference)
    if float(difference @ each.direction) < 0:
        # The camera stands on the other side: the direction is wrong, or the centres are still.
        misfit += (float(difference @ each.direction) ** 2) * float(np.trace(weight)) / 2
    weight = weight / (1 + misfit / 4)
    jacobian = np.zeros((3, 3 * len(centres)))
    jacobian[:, 3 * each.i : 3 * each.i + 3] = -np.eye(3)
    jacobian[:, 3 * each.j : 3 * each.j + 3] = np.eye(3)
    return np.asarray(jacobian.T @ weight @ jacobian)
