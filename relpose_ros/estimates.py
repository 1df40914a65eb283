"""What we tell: modes, pairs, cameras and the estimate of a scan. Data only.

Optical frames (x right, y down, z forward) and column vectors throughout: ``a_from_b`` maps
coordinates in frame b to coordinates in frame a.

The object frame has its origin at the point closest to the cameras' lines of sight through the object's
boxes, as far as it is known, and the axes of the first view's optical frame. Unless the scale is known, its
unit of length is the distance from that origin to the first camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]


class Verdict(IntEnum):
    """What a planner may do with an estimate. Values are those of ScanEstimate.msg."""

    ENOUGH = 1
    ONE_MORE_VIEW = 2


class Evidence(IntFlag):
    """What a pair's distribution rests on. Values are those of PairUncertainty.msg."""

    LEARNED = 1
    GEOMETRIC = 2


@dataclass(frozen=True, eq=False)
class Mode:
    """A local maximum of a pair's distribution over the relative rotation."""

    camera_j_from_camera_i: FloatArray
    """(3, 3) rotation."""
    weight: float
    """Probability mass of the mode's basin, 0 to 1."""
    covariance: FloatArray
    """(3, 3), rad^2, of the rotation vector in the axes of camera j (left perturbation): how exact the mode
    is where it is right. Mass far from it counts little."""


@dataclass(frozen=True, eq=False)
class PairRotation:
    """The distribution of one pair's relative rotation, and how the final poses agree with it."""

    i: int
    j: int
    """Positions of the two views in the scan, i < j."""
    camera_j_from_camera_i: FloatArray
    """(3, 3) rotation of the strongest mode."""
    covariance: FloatArray
    """(3, 3), rad^2: total second moment of the distribution about the strongest mode, axes of camera j.
    Other modes and whatever chance there is that none is right make it large."""
    entropy: float
    """Nats, relative to the uniform distribution on SO(3): 0 knows nothing, lower knows more."""
    probability_within_15_deg: float
    """Probability that the true rotation lies within 15 degrees of the strongest mode."""
    modes: tuple[Mode, ...]
    """Strongest first."""
    ambiguous: bool
    """Whether a second mode matters."""
    ambiguity_angle: float
    """Angle between the strongest mode and the runner-up, rad; 0 where the pair is not ambiguous."""
    solution_probability: float
    """Probability that the true rotation lies within 15 degrees of the final poses' relative rotation."""
    solution_angle: float
    """Angle from the final poses' relative rotation to the nearest of the modes, rad."""
    evidence: Evidence = Evidence.LEARNED


@dataclass(frozen=True, eq=False)
class CameraPose:
    """One camera in the object frame."""

    view: int
    """Position of the view in the scan."""
    object_from_camera: FloatArray
    """(3, 3) rotation."""
    position: FloatArray
    """(3,) camera centre in the object frame: metres where the scale is known, else see the module."""
    covariance: FloatArray
    """(6, 6) of x, y, z and the rotation about X, Y, Z, fixed axes of the object frame
    (geometry_msgs/PoseWithCovariance): position unit^2, rad^2."""


@dataclass(frozen=True, eq=False)
class ObjectPose:
    """The object frame in the robot's frame."""

    frame_id: str
    """The robot's frame."""
    robot_from_object: FloatArray
    """(3, 3) rotation."""
    position: FloatArray
    """(3,) the object frame's origin in the robot's frame, metres."""
    covariance: FloatArray
    """(6, 6) of x, y, z and the rotation about X, Y, Z, fixed axes of the robot's frame: m^2, rad^2."""


@dataclass(frozen=True, eq=False)
class ScanEstimate:
    """The poses of all views of a scan, the pairs they rest on, and a verdict."""

    object_id: str
    cameras: tuple[CameraPose, ...]
    """One per view, in the scan's order."""
    pairs: tuple[PairRotation, ...]
    """Every pair i < j, ordered by i, then j."""
    score: float
    """Joint energy of the rotations: the sum over pairs, an unnormalised log-likelihood."""
    scale_known: bool
    """Whether positions are in metres."""
    calibrated: bool
    """Whether the probabilities were calibrated on held-out scans for the weights in use."""
    verdict: Verdict
    weakest_pair: int
    """Position in ``pairs`` of the least certain one."""
    status: str
    """The verdict in words, for a person."""
    seconds: float
    """Wall-clock time the estimate took; 0 in a replay, whose files must not differ between runs."""
    scale_deviation: float = 0.0
    """Standard deviation of the scale, relative to it, where it follows from the robot's camera poses; 0
    elsewhere. The cameras' covariances contain it."""
    object_pose: ObjectPose | None = None
    """Where the scale follows from the robot's camera poses."""
