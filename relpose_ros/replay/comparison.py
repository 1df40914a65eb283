"""An estimate held against the true camera poses, where a bag has them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.geometry.alignment import Similarity, align_points, align_rotations

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from relpose_ros.estimates import FloatArray, ScanEstimate

MIN_CENTRES = 3
"""Two camera centres can always be aligned, so that their errors would say nothing."""


@dataclass(frozen=True, eq=False)
class TruePose:
    """Where a camera really was, in a world frame and scale of the bag's own."""

    world_from_camera: FloatArray
    """(3, 3) rotation, optical frame."""
    centre: FloatArray
    """(3,)."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of one estimate."""

    rotation_errors: Mapping[tuple[int, int], float]
    """Angle between estimated and true relative rotation of views i < j, degrees; only pairs with truth."""
    centre_errors: Mapping[int, float] | None
    """Distance of each camera centre to the true one after the best similarity, in scene scales; None for
    fewer than three views with truth."""
    aligned: Mapping[int, TruePose]
    """The true poses in the estimate's object frame, under the same similarity."""


def compare(
    estimate: ScanEstimate, stamps: Sequence[int], truth: Mapping[int, TruePose]
) -> Comparison | None:
    """Errors of an estimate by the protocol of RelPose++, section 4.2.

    The scene scale is the distance from the centroid of all true cameras of the bag to the furthest one.

    Args:
        estimate: Of a scan.
        stamps: Stamp of each of its views, ns.
        truth: True poses by stamp.

    Returns:
        None where fewer than two of the views have a true pose.
    """
    known = [camera for camera in estimate.cameras if stamps[camera.view] in truth]
    if len(known) < 2:
        return None
    true = [truth[stamps[camera.view]] for camera in known]
    estimated_rotations = np.stack([camera.object_from_camera for camera in known])
    true_rotations = np.stack([pose.world_from_camera for pose in true])
    centres = np.stack([camera.position for camera in known])
    true_centres = np.stack([pose.centre for pose in true])

    rotation_errors = {}
    for a, first in enumerate(known):
        for b in range(a + 1, len(known)):
            error = so3.angle_between(
                estimated_rotations[b].T @ estimated_rotations[a], true_rotations[b].T @ true_rotations[a]
            )
            rotation_errors[first.view, known[b].view] = float(np.degrees(error))

    if len(known) >= MIN_CENTRES:
        world_from_object = align_points(centres, true_centres)
    else:
        world_from_object = _align_two(estimated_rotations, true_rotations, centres, true_centres)
    everywhere = np.stack([pose.centre for pose in truth.values()])
    scale = float(np.linalg.norm(everywhere - everywhere.mean(axis=0), axis=1).max())
    centre_errors = None
    if len(known) >= MIN_CENTRES and scale > 0:
        distances = np.linalg.norm(world_from_object.apply(centres) - true_centres, axis=1) / scale
        centre_errors = {camera.view: float(error) for camera, error in zip(known, distances, strict=True)}
    aligned = {}
    if world_from_object.scale > 0:
        rotation = world_from_object.rotation
        for camera, pose in zip(known, true, strict=True):
            offset = pose.centre - world_from_object.translation
            aligned[camera.view] = TruePose(
                world_from_camera=rotation.T @ pose.world_from_camera,
                centre=rotation.T @ offset / world_from_object.scale,
            )
    return Comparison(rotation_errors, centre_errors, aligned)


def _align_two(
    rotations: FloatArray, true_rotations: FloatArray, centres: FloatArray, true_centres: FloatArray
) -> Similarity:
    """A similarity for two cameras, whose centres leave the turn about their line free: rotations first."""
    object_from_world = align_rotations(rotations.transpose(0, 2, 1), true_rotations.transpose(0, 2, 1))
    baseline = float(np.linalg.norm(centres[1] - centres[0]))
    true_baseline = float(np.linalg.norm(true_centres[1] - true_centres[0]))
    scale = true_baseline / baseline if baseline > 0 else 0.0
    translation = true_centres.mean(axis=0) - scale * object_from_world.T @ centres.mean(axis=0)
    return Similarity(scale, object_from_world.T, translation)
