"""What the sensors gave: boxes, views and scans. Data only.

Pixel coordinates are those of the full camera image, x right and y down, with (0, 0) at the outer
corner of the first pixel (its centre is (0.5, 0.5)). ROS and OpenCV put (0, 0) at that centre:
whatever reads such messages adds half a pixel, once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

MIN_VIEWS = 2
MAX_VIEWS = 8
"""The network's index table has eight rows (RelPose++ is trained on 2 to 8 views)."""
GUESSED_FOCAL = 1.2
"""Focal length in longer image sides where a camera said nothing: a phone's main camera, and between a
webcam's and a portrait lens's."""


@dataclass(frozen=True)
class BoundingBox:
    """An axis-aligned box in the full image, pixels: left, top, right, bottom."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def width(self) -> float:
        """Width in pixels."""
        return self.x1 - self.x0

    @property
    def height(self) -> float:
        """Height in pixels."""
        return self.y1 - self.y0


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics of the full image, in pixels (corner convention, see above)."""

    fx: float
    fy: float
    cx: float
    cy: float

    @classmethod
    def guessed(cls, width: int, height: int) -> Intrinsics:
        """What to assume of a camera that said nothing but the size of its image, pixels."""
        focal = GUESSED_FOCAL * max(width, height)
        return cls(focal, focal, width / 2, height / 2)


@dataclass(frozen=True)
class Distortion:
    """How a lens bends the rays of a picture that nobody rectified: OpenCV's models, as in CameraInfo."""

    coefficients: tuple[float, ...]
    """k1, k2, p1, p2 and so on, for rays (x / z, y / z)."""
    equidistant: bool = False
    """Whether they are k1 to k4 of the fisheye model (Kannala and Brandt 2006)."""


@dataclass(frozen=True, eq=False)
class View:
    """One picture of the object.

    Two views are equal only when they are the same object: a view is the key under which its
    features are kept, and comparing pixels would cost more than recomputing them.
    """

    image: npt.NDArray[np.uint8]
    """(H, W, 3) RGB. The whole camera image, or the part of it that starts at ``origin``."""
    box: BoundingBox
    """The object's box, in the full image."""
    full_width: int
    """Width of the full image, pixels."""
    full_height: int
    """Height of the full image, pixels."""
    origin: tuple[int, int] = (0, 0)
    """Column and row of ``image``'s first pixel in the full image."""
    stamp_ns: int = 0
    """Acquisition time, nanoseconds (the message's own stamp, never the time of arrival)."""
    frame_id: str = ""
    """The camera's optical frame (REP-103: x right, y down, z forward)."""
    intrinsics: Intrinsics | None = None
    """None where the camera said nothing."""
    distortion: Distortion | None = None
    """None of a rectified picture; ``intrinsics`` are there where it is not None."""
    mask: npt.NDArray[np.bool_] | None = None
    """(H, W), True on the object; None where nobody segmented it."""


@dataclass(frozen=True, eq=False)
class RobotPose:
    """Where a robot says that a camera stood: its optical frame in a frame of the robot's that stays put."""

    frame_id: str
    """That frame: the robot's base, odom, map. Called ``robot`` below."""
    robot_from_camera: npt.NDArray[np.float64]
    """(3, 3) rotation."""
    position: npt.NDArray[np.float64]
    """(3,) camera centre in the robot's frame, metres."""
    covariance: npt.NDArray[np.float64]
    """(6, 6) of x, y, z and the rotation about X, Y, Z, fixed axes of the robot's frame
    (geometry_msgs/PoseWithCovariance): m^2, rad^2."""
    stated: bool = True
    """Whether that covariance came with the pose; else it is what the user said of all poses."""


@dataclass(frozen=True, eq=False)
class Scan:
    """The views held of one object, oldest first. The first one sets the gauge of the estimate."""

    object_id: str
    views: tuple[View, ...]
    robot_poses: tuple[RobotPose | None, ...] = ()
    """One per view, None where nobody said; empty where nobody said anything. They may come after their
    views, so they are not a part of them."""
