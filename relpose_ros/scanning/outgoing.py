"""Our estimates as messages: ScanEstimate, PoseArray and MarkerArray, all under one header.

The functions know the fields of messages, not their classes: ``types`` maps names such as
``geometry_msgs/msg/Pose`` to what builds such a message from keyword arguments. A rosbags type store's
``types`` is such a mapping; the node makes one from the classes it imports.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from relpose_ros.estimates import ScanEstimate
    from relpose_ros.views import Scan

MessageTypes: TypeAlias = Mapping[str, Callable[..., Any]]

TYPE_NAMES = (
    "builtin_interfaces/msg/Duration",
    "builtin_interfaces/msg/Time",
    "geometry_msgs/msg/Point",
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/PoseArray",
    "geometry_msgs/msg/PoseWithCovariance",
    "geometry_msgs/msg/Quaternion",
    "geometry_msgs/msg/Vector3",
    "relpose_ros/msg/CameraEstimate",
    "relpose_ros/msg/PairUncertainty",
    "relpose_ros/msg/RotationMode",
    "relpose_ros/msg/ScanEstimate",
    "sensor_msgs/msg/CompressedImage",
    "std_msgs/msg/ColorRGBA",
    "std_msgs/msg/Header",
    "visualization_msgs/msg/Marker",
    "visualization_msgs/msg/MarkerArray",
    "visualization_msgs/msg/MeshFile",
)
"""Every type that ``types`` must hold."""


def estimate_message(
    estimate: ScanEstimate, scan: Scan, types: MessageTypes, object_frame: str, *, timed: bool = True
) -> Any:
    """A relpose_ros/ScanEstimate.

    Args:
        estimate: What to tell.
        scan: The views it was made from: they give the stamps and the camera frames.
        types: The message types to fill.
        object_frame: Name of the object frame.
        timed: Whether ``seconds`` goes out; False (zero) where two runs must not differ.
    """
    raise NotImplementedError


def pose_array(estimate: ScanEstimate, scan: Scan, types: MessageTypes, object_frame: str) -> Any:
    """A geometry_msgs/PoseArray: the camera optical frames in the object frame, in the scan's order."""
    raise NotImplementedError


def markers(estimate: ScanEstimate, scan: Scan, types: MessageTypes, object_frame: str) -> Any:
    """A visualization_msgs/MarkerArray: cameras, object and weak pairs, after a DELETEALL."""
    raise NotImplementedError
