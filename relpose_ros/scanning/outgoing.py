"""Our estimates as messages: ScanEstimate, PoseArray and MarkerArray, all under one header.

The functions know the fields of messages, not their classes: ``types`` maps names such as
``geometry_msgs/msg/Pose`` to what builds such a message from keyword arguments. A rosbags type store's
``types`` is such a mapping; the node makes one from the classes it imports.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.views import MAX_VIEWS

if TYPE_CHECKING:
    from relpose_ros.estimates import CameraPose, FloatArray, Mode, PairRotation, ScanEstimate
    from relpose_ros.views import Scan, View

MessageTypes: TypeAlias = Mapping[str, Callable[..., Any]]

TYPE_NAMES = (
    "builtin_interfaces/msg/Duration",
    "builtin_interfaces/msg/Time",
    "geometry_msgs/msg/Point",
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/PoseArray",
    "geometry_msgs/msg/PoseWithCovariance",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
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


WEAK_PROBABILITY = 0.5
"""A pair is drawn as weak where it is ambiguous, or less likely than this to be within 15 degrees."""

_SPHERE, _LINE_LIST, _TEXT = 2, 5, 9
_ADD, _DELETE_ALL = 0, 3
_WHITE = (1.0, 1.0, 1.0)
_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


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
    return types["relpose_ros/msg/ScanEstimate"](
        header=_scan_header(scan, types, object_frame),
        object_id=estimate.object_id,
        cameras=[_camera(camera, scan.views[camera.view], types) for camera in estimate.cameras],
        pairs=[_pair(pair, types) for pair in estimate.pairs],
        score=float(estimate.score),
        scale_known=bool(estimate.scale_known),
        scale_deviation=float(estimate.scale_deviation),
        object_pose=_object_pose(estimate, scan, types),
        calibrated=bool(estimate.calibrated),
        verdict=int(estimate.verdict),
        weakest_pair=int(estimate.weakest_pair),
        status=estimate.status,
        seconds=float(estimate.seconds) if timed else 0.0,
    )


def pose_array(estimate: ScanEstimate, scan: Scan, types: MessageTypes, object_frame: str) -> Any:
    """A geometry_msgs/PoseArray: the camera optical frames in the object frame, in the scan's order."""
    return types["geometry_msgs/msg/PoseArray"](
        header=_scan_header(scan, types, object_frame),
        poses=[_pose(types, camera.position, camera.object_from_camera) for camera in estimate.cameras],
    )


def markers(estimate: ScanEstimate, scan: Scan, types: MessageTypes, object_frame: str) -> Any:
    """A visualization_msgs/MarkerArray of the cameras, the object's origin and the weak pairs.

    Each camera is a frustum in its view's colour with its index above it; a line joins the cameras of a weak
    pair and says what is wrong with it. All sizes follow the cameras' distances, since the scale may be
    anything. The first marker deletes all earlier ones: there may be fewer views or weak pairs than before.
    An estimate without cameras is that marker alone.
    """
    header = _scan_header(scan, types, object_frame)
    array = [_marker(types, header, "", 0, _SPHERE, action=_DELETE_ALL)]
    if not estimate.cameras:
        return types["visualization_msgs/msg/MarkerArray"](markers=array)
    positions = np.array([camera.position for camera in estimate.cameras])
    # A size of zero would make the viewer complain.
    size = max(0.2 * float(np.median(np.linalg.norm(positions, axis=1))), 1e-3)
    for axis, colour in enumerate(_AXES):
        tip = size * np.eye(3)[axis]
        array.append(
            _marker(
                types, header, "object", axis, _LINE_LIST,
                scale=(0.1 * size, 0.0, 0.0), colour=colour, points=np.stack([np.zeros(3), tip]),
            )
        )  # fmt: skip
    array.append(_marker(types, header, "object", 3, _SPHERE, scale=(0.3 * size,) * 3, colour=_WHITE))
    for camera in estimate.cameras:
        view, colour = scan.views[camera.view], view_colour(camera.view)
        array.append(
            _marker(
                types, header, "cameras", camera.view, _LINE_LIST,
                position=camera.position, rotation=camera.object_from_camera,
                scale=(0.05 * size, 0.0, 0.0), colour=colour, points=_frustum(view, size),
            )
        )  # fmt: skip
        above = camera.position + camera.object_from_camera @ np.array([0.0, -size, 0.0])
        array.append(
            _marker(
                types, header, "indices", camera.view, _TEXT,
                position=above, scale=(0.0, 0.0, 0.5 * size), colour=colour, text=str(camera.view),
            )
        )  # fmt: skip
    weak = [pair for pair in estimate.pairs if is_weak(pair)]
    for number, pair in enumerate(weak):
        ends = positions[[pair.i, pair.j]]
        array.append(
            _marker(
                types, header, "weak_pairs", number, _LINE_LIST,
                scale=(0.03 * size, 0.0, 0.0), colour=_WHITE, points=ends,
            )
        )  # fmt: skip
        array.append(
            _marker(
                types, header, "weak_pair_reasons", number, _TEXT,
                position=ends.mean(axis=0), scale=(0.0, 0.0, 0.3 * size), colour=_WHITE, text=_weakness(pair),
            )
        )  # fmt: skip
    return types["visualization_msgs/msg/MarkerArray"](markers=array)


def view_colour(index: int) -> tuple[float, float, float]:
    """The colour of a view, (r, g, b) of 0 to 1: red for the first to magenta for the last a scan can have.

    A view keeps its colour while further ones arrive.
    """
    return colorsys.hsv_to_rgb(index / (MAX_VIEWS - 1) * 5 / 6, 1.0, 1.0)


def is_weak(pair: PairRotation) -> bool:
    """Whether a person who looks at the cameras should be told about this pair."""
    return pair.ambiguous or pair.probability_within_15_deg < WEAK_PROBABILITY


def _weakness(pair: PairRotation) -> str:
    if pair.ambiguous:
        return f"{pair.i}-{pair.j}: ambiguous by {np.degrees(pair.ambiguity_angle):.0f} deg"
    return f"{pair.i}-{pair.j}: {100 * pair.probability_within_15_deg:.0f} % sure"


def _frustum(view: View, size: float) -> FloatArray:
    """Ends of the line segments that draw a camera, (20, 3), in its optical frame."""
    half_width, half_height = 0.5 * size, 0.5 * size * view.full_height / view.full_width
    corners = [
        np.array([x * half_width, y * half_height, size]) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    # The roof shows which way is up in the image.
    roof = np.array([0.0, -1.6 * half_height, size])
    ends = [end for corner in corners for end in (np.zeros(3), corner)]
    ends += [end for k in range(4) for end in (corners[k], corners[(k + 1) % 4])]
    ends += [corners[0], roof, roof, corners[1]]
    return np.stack(ends)


def _object_pose(estimate: ScanEstimate, scan: Scan, types: MessageTypes) -> Any:
    frame, position, rotation = "", np.zeros(3), np.eye(3)
    covariance = np.zeros((6, 6))
    covariance[0, 0] = -1.0  # what ROS's messages mean by "not known"
    if estimate.object_pose is not None:
        known = estimate.object_pose
        frame, position, rotation = known.frame_id, known.position, known.robot_from_object
        covariance = known.covariance
    return types["geometry_msgs/msg/PoseWithCovarianceStamped"](
        header=_scan_header(scan, types, frame),
        pose=types["geometry_msgs/msg/PoseWithCovariance"](
            pose=_pose(types, position, rotation), covariance=_flat(covariance)
        ),
    )


def _camera(camera: CameraPose, view: View, types: MessageTypes) -> Any:
    return types["relpose_ros/msg/CameraEstimate"](
        header=_header(types, view.stamp_ns, view.frame_id),
        view=int(camera.view),
        pose=types["geometry_msgs/msg/PoseWithCovariance"](
            pose=_pose(types, camera.position, camera.object_from_camera), covariance=_flat(camera.covariance)
        ),
    )


def _pair(pair: PairRotation, types: MessageTypes) -> Any:
    return types["relpose_ros/msg/PairUncertainty"](
        i=int(pair.i),
        j=int(pair.j),
        orientation=_quaternion(types, pair.camera_j_from_camera_i),
        covariance=_flat(pair.covariance),
        entropy=float(pair.entropy),
        probability_within_15_deg=float(pair.probability_within_15_deg),
        modes=[_mode(mode, types) for mode in pair.modes],
        ambiguous=bool(pair.ambiguous),
        ambiguity_angle=float(pair.ambiguity_angle),
        solution_probability=float(pair.solution_probability),
        solution_angle=float(pair.solution_angle),
        evidence=int(pair.evidence),
    )


def _mode(mode: Mode, types: MessageTypes) -> Any:
    return types["relpose_ros/msg/RotationMode"](
        orientation=_quaternion(types, mode.camera_j_from_camera_i),
        weight=float(mode.weight),
        covariance=_flat(mode.covariance),
    )


def _flat(matrix: FloatArray) -> FloatArray:
    """Row-major, contiguous: what a fixed-size array field of either message library takes."""
    return np.array(matrix, np.float64).reshape(-1)


def _scan_header(scan: Scan, types: MessageTypes, object_frame: str) -> Any:
    return _header(types, max(view.stamp_ns for view in scan.views), object_frame)


def _header(types: MessageTypes, stamp_ns: int, frame_id: str) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)


def _pose(types: MessageTypes, position: FloatArray, rotation: FloatArray) -> Any:
    return types["geometry_msgs/msg/Pose"](
        position=_point(types, position), orientation=_quaternion(types, rotation)
    )


def _point(types: MessageTypes, position: FloatArray) -> Any:
    return types["geometry_msgs/msg/Point"](x=float(position[0]), y=float(position[1]), z=float(position[2]))


def _quaternion(types: MessageTypes, rotation: FloatArray) -> Any:
    x, y, z, w = so3.quaternion_xyzw(rotation).tolist()
    return types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def _marker(
    types: MessageTypes,
    header: Any,
    namespace: str,
    number: int,
    kind: int,
    *,
    action: int = _ADD,
    position: FloatArray | None = None,
    rotation: FloatArray | None = None,
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0),
    colour: tuple[float, float, float] = _WHITE,
    points: FloatArray | None = None,
    text: str = "",
) -> Any:
    """A visualization_msgs/Marker with every field given: a bag's message type has no defaults."""
    red, green, blue = colour
    no_bytes = np.zeros(0, np.uint8)
    return types["visualization_msgs/msg/Marker"](
        header=header,
        ns=namespace,
        id=number,
        type=kind,
        action=action,
        pose=_pose(
            types, np.zeros(3) if position is None else position, np.eye(3) if rotation is None else rotation
        ),
        scale=types["geometry_msgs/msg/Vector3"](x=scale[0], y=scale[1], z=scale[2]),
        color=types["std_msgs/msg/ColorRGBA"](r=red, g=green, b=blue, a=1.0),
        lifetime=types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0),
        frame_locked=False,
        points=[] if points is None else [_point(types, point) for point in points],
        colors=[],
        texture_resource="",
        texture=types["sensor_msgs/msg/CompressedImage"](
            header=_header(types, 0, ""), format="", data=no_bytes
        ),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=types["visualization_msgs/msg/MeshFile"](filename="", data=no_bytes),
        mesh_use_embedded_materials=False,
    )
