"""Where the cameras stand: what the network says of each, and the directions between them, by matches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]

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
    turn: FloatArray,
) -> Baseline:
    """From a relative pose's translation.

    Args:
        i: A view.
        j: Another.
        camera_from_object: (3, 3) rotation of camera j.
        direction: (3,) unit translation of camera_j_from_camera_i: where camera i stands, seen from j.
        covariance: (3, 3) of it.
        turn: (3, 3) covariance of camera j's rotation in the object frame, rad^2: it turns the direction too.
    """
    towards = -camera_from_object.T @ direction
    across = np.eye(3) - np.outer(towards, towards)
    swing = np.trace(across @ turn) / 2 * across
    return Baseline(i, j, towards, camera_from_object.T @ covariance @ camera_from_object + swing)


def place(
    centres: FloatArray, covariances: FloatArray, baselines: Sequence[Baseline]
) -> tuple[FloatArray, FloatArray]:
    """The centres that suit both what was known of each and the directions between them.

    Linear least squares on the part of each difference of centres that is across its direction, reweighted by
    distance and, as Cauchy's loss has it, by how well it fits. What the covariances say of the rotations
    follows from how they go along with the positions.

    Args:
        centres: (N, 3) known before, object frame.
        covariances: (N, 6, 6) of position and rotation, as `relpose_ros.estimates.CameraPose` has them.
        baselines: May be few, or contradict each other.

    Returns:
        (N, 3) and (N, 6, 6).
    """
    if not baselines:
        return centres, covariances
    count = len(centres)
    prior = np.zeros((3 * count, 3 * count))
    for camera in range(count):
        block = slice(3 * camera, 3 * camera + 3)
        prior[block, block] = np.linalg.inv(covariances[camera, :3, :3])
    target = prior @ centres.reshape(-1)
    found = centres
    for _ in range(ROUNDS):
        information = prior.copy()
        for each in baselines:
            information += _information(each, found)
        found = np.linalg.solve(information, target).reshape(-1, 3)
    spread = np.linalg.inv(information)
    updated = covariances.copy()
    for camera in range(count):
        block = slice(3 * camera, 3 * camera + 3)
        updated[camera] = _conditioned(covariances[camera], spread[block, block])
    return found, updated


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


def _conditioned(covariance: FloatArray, position: FloatArray) -> FloatArray:
    """A pose's covariance once its position is known to ``position`` (3, 3). (6, 6) -> (6, 6)."""
    gain = np.linalg.solve(covariance[:3, :3], covariance[:3, 3:]).T  # rotation per position
    updated = covariance.copy()
    updated[:3, :3] = position
    updated[3:, :3] = gain @ position
    updated[:3, 3:] = updated[3:, :3].T
    updated[3:, 3:] += gain @ (position - covariance[:3, :3]) @ gain.T
    return np.asarray((updated + updated.T) / 2)
