"""Poses that a network predicts outright, no solver asked: translations, and in one ablation rotations.

Optical frames, column vectors; the first camera is at distance 1 from the origin of the object's frame. As
predicted that is where the optical axes meet most closely, whichever origin the network's preset has.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import camera_centre, closest_point_to_axes, closest_point_to_rays, in_world
from relpose_ros.inference.outlines import sightlines

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from relpose_ros.inference.outlines import Outline
    from relpose_ros.network.features import SceneFeatures
    from relpose_ros.network.relpose import RelPose

    FloatArray = npt.NDArray[np.float64]

WHERE_IT_WAS = 0.01
"""How much the origin as predicted counts beside a line of sight, which is some ten times as exact."""
LEAST_DISTANCE = 1e-6
"""Of a camera from the object's origin, in the network's unit: what is predicted may be anything."""


@torch.no_grad()
def predicted_translations(network: RelPose, features: SceneFeatures, rotations: FloatArray) -> FloatArray:
    """Translations camera_from_object that go with some rotations.

    A network that predicts in the first camera's frame says where the cameras are, not where the object is:
    the origin is moved to the point closest to the optical axes, as in training (RelPose++, section 3.3).

    Args:
        network: of any preset.
        features: of the N views of one scan.
        rotations: (N, 3, 3) camera_from_object, the first the identity.

    Returns:
        (N, 3), the first at distance 1.
    """
    translations = network.optical_translations(features).double().cpu().numpy()
    if network.preset.translation_frame == "first_camera":
        origin = closest_point_to_axes(rotations, camera_centre(rotations, translations))
        translations = translations + rotations @ origin
    return _first_at_one(translations)


def about_the_object(
    rotations: FloatArray, translations: FloatArray, outlines: Sequence[Outline | None]
) -> FloatArray:
    """The same cameras about the object, which need not be where their optical axes meet.

    The origin moves to the point closest to the lines of sight and, a hundredth as much, to where it was: so
    that lines that are all but parallel leave it as far away as predicted.

    Args:
        rotations: (N, 3, 3) camera_from_object.
        translations: (N, 3) about where the axes meet.
        outlines: where the cameras see the object; None of one that does not tell.

    Returns:
        (N, 3), the first at distance 1.
    """
    told = [camera for camera, outline in enumerate(outlines) if outline is not None]
    if not told:
        return _first_at_one(translations)
    rays = in_world(rotations, sightlines(outlines))[told]
    centres = camera_centre(rotations, translations)[told]
    origin = closest_point_to_rays(rays, centres, WHERE_IT_WAS * len(outlines))
    return _first_at_one(translations + rotations @ origin)


def _first_at_one(translations: FloatArray) -> FloatArray:
    return np.asarray(translations / max(float(np.linalg.norm(translations[0])), LEAST_DISTANCE))


@torch.no_grad()
def regressed_poses(network: RelPose, features: SceneFeatures) -> tuple[FloatArray, FloatArray]:
    """Poses camera_from_object of a network that regresses rotations.

    Args:
        network: of a preset whose ``rotation`` is "regression".
        features: of the N views of one scan.

    Returns:
        Rotations (N, 3, 3), the first the identity, and translations (N, 3), the first at distance 1.

    Raises:
        NetworkUseError: The preset scores rotations instead: use `Estimator`.
    """
    rotations = so3.project(network.optical_rotations(features).double().cpu().numpy())
    rotations = rotations @ rotations[0].T  # the identity to the last digit, not to float32's
    return rotations, predicted_translations(network, features, rotations)
