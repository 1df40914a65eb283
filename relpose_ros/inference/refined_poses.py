"""What a bundle adjustment makes of an estimate: its frame and its covariances.

The object frame has its origin where the cameras' lines of sight to the object meet most closely and its unit
in the first camera's distance. Refined poses tell both by themselves, far better than was known before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.geometry import cameras, so3
from relpose_ros.inference.camera_positions import rows_of
from relpose_ros.inference.matches import MATCHING_FLOOR, WIDENING
from relpose_ros.inference.two_view_poses import guessed_focal_covariance

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from relpose_ros.inference.bundle_adjustment import Refined

    FloatArray = npt.NDArray[np.float64]
    IntArray = npt.NDArray[np.int64]

SIGHTLINES_APART = 0.1
"""Standard deviation, in the estimate's unit, of how far the lines of sight of cameras that the adjustment
left out pass from the point where the others' meet: the middle of a box is not the same point of the object
from all sides."""
STEP = 1e-6
"""Of the numeric derivative of the frame by the poses."""


def settle(
    refined: Refined, joint: FloatArray, sightlines: FloatArray, *, guessed: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Centres and joint covariance after a bundle adjustment, in the frame of the estimate.

    What the points tell joins what was known before, widened as a pair's matches are: errors of features near
    each other go together, and of the intrinsics nothing is averaged away. Of groups that no sure matches tie
    the points tell each for itself, since the points come from the matches and would share their mistake.
    Cameras that took no part stay where they were; their errors no longer go with those of the others.

    Args:
        refined: The adjustment's poses and what its points tell.
        joint: (6 N, 6 N) covariance before.
        sightlines: (N, 3) unit vectors towards the object, in the cameras' axes.
        guessed: Whether a focal length was guessed. Points cannot tell: through a wrong one they fit poses
            that go around the object by more or less.

    Returns:
        (N, 3) and (6 N, 6 N).
    """
    rotations, moved = refined.rotations, list(refined.moved)
    centres = cameras.camera_centre(rotations, refined.translations)
    rows = rows_of(moved)
    changes = np.zeros((len(moved), 6, len(moved), 6))
    for slot, camera in enumerate(moved):
        changes[slot, :, slot] = _by_adjustment(rotations[camera], refined.translations[camera])
    jacobian = changes.reshape(len(rows), len(rows))
    told = jacobian.T @ refined.information @ jacobian / WIDENING
    share = np.ones(len(rows))
    groups = [np.searchsorted(moved, group).tolist() for group in refined.groups]
    for group in groups:
        # The points leave it to what was known before where their cameras stand as a whole. The first camera
        # sets the frame; of the others, which erred together, all know as much of that as one.
        others = [slot for slot in group if moved[slot] != 0]
        share[rows_of(others)] = 1 / np.sqrt(max(len(others), 1))
    told = _informative(_each_for_itself(told, [rows_of(group) for group in groups]))
    before = share[:, None] * np.linalg.inv(joint[np.ix_(rows, rows)]) * share
    spread = np.asarray(np.linalg.inv(before + told))
    if 0 in moved:
        silent = 1 - len(moved) / len(rotations)
        centres[moved], spread = _about_the_object(
            rotations[moved], centres[moved], sightlines[moved], spread, silent
        )
    for slot, camera in enumerate(moved):
        own = np.arange(6 * slot, 6 * slot + 6)
        spread[own[:3], own[:3]] += MATCHING_FLOOR**2 * float(centres[camera] @ centres[camera])
        if camera != 0:  # whose axes are the frame's
            spread[own[3:], own[3:]] += MATCHING_FLOOR**2
        if guessed:
            around = np.concatenate([-so3.hat(centres[camera]), np.eye(3)])  # a turn about the object
            turned = guessed_focal_covariance(so3.log(rotations[camera]))
            spread[np.ix_(own, own)] += around @ turned @ around.T
    settled = joint.copy()
    settled[rows] = 0
    settled[:, rows] = 0
    settled[np.ix_(rows, rows)] = (spread + spread.T) / 2
    return centres, settled


def _each_for_itself(information: FloatArray, groups: Sequence[IntArray]) -> FloatArray:
    """An information matrix without what it says of how some groups of rows go together."""
    apart = np.zeros_like(information)
    for own in groups:
        others = np.setdiff1d(np.arange(len(information)), own)
        across = information[np.ix_(own, others)]
        spread = np.linalg.pinv(information[np.ix_(others, others)], rcond=1e-10, hermitian=True)
        apart[np.ix_(own, own)] = information[np.ix_(own, own)] - across @ spread @ across.T
    return apart


def _informative(information: FloatArray) -> FloatArray:
    """An information matrix without negative parts, which rounding makes of points near a camera's plane."""
    told, axes = np.linalg.eigh((information + information.T) / 2)
    return np.asarray(axes * np.maximum(told, 0) @ axes.T)


def _by_adjustment(camera_from_object: FloatArray, translation: FloatArray) -> FloatArray:
    """From a small change of position and rotation in the object frame to the adjustment's own. -> (6, 6).

    A turn r of the camera in the object's axes is the turn e = -R r of camera_from_object; it and a shift d
    of the centre change the translation t by -R d + e x t.
    """
    change = np.zeros((6, 6))
    change[:3, 3:] = change[3:, :3] = -camera_from_object
    change[3:, 3:] = so3.hat(translation) @ camera_from_object
    return change


def _about_the_object(
    rotations: FloatArray, centres: FloatArray, sightlines: FloatArray, spread: FloatArray, silent: float
) -> tuple[FloatArray, FloatArray]:
    """Origin where the lines of sight meet, first camera at distance 1; as it was where they hardly meet.

    Args:
        rotations: (M, 3, 3) camera_from_object, the scan's first camera first.
        centres: (M, 3).
        sightlines: (M, 3).
        spread: (6 M, 6 M) their covariance.
        silent: Share of the scan's cameras that are not among these, which the origin belongs to as well.
    """
    rays = cameras.in_world(rotations, sightlines)
    origin = cameras.closest_point_to_rays(rays, centres)
    in_front = np.einsum("ma,ma->m", rays, origin - centres)
    if in_front.min() <= 0:
        return centres, spread
    size = len(spread)
    jacobian = np.eye(size)
    positions = rows_of(range(len(centres)), 3)
    shifts = STEP * np.eye(size).reshape(size, len(centres), 6)
    above, below = (_framed(rays, centres, sign * shifts) for sign in (1.0, -1.0))
    jacobian[positions] = (above - below).reshape(size, -1).T / (2 * STEP)
    framed = jacobian @ spread @ jacobian.T
    if np.trace(framed[np.ix_(positions, positions)]) > np.trace(spread[np.ix_(positions, positions)]):
        return centres, spread
    together = np.kron(np.ones((len(centres), len(centres))), np.eye(3))
    framed[np.ix_(positions, positions)] += (SIGHTLINES_APART * silent) ** 2 * together
    return _framed(rays, centres, np.zeros((len(centres), 6))), framed


def _framed(rays: FloatArray, centres: FloatArray, change: FloatArray) -> FloatArray:
    """Centres about the point closest to all rays, after changes (..., M, 6) of positions and rotations."""
    turned = (so3.exp(change[..., 3:]) @ rays[..., None])[..., 0]
    moved = centres + change[..., :3]
    offsets = moved - cameras.closest_point_to_rays(turned, moved)[..., None, :]
    return np.asarray(offsets / np.linalg.norm(offsets[..., :1, :], axis=-1, keepdims=True))
