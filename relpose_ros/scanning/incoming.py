"""Messages to views: what a message claims is checked here, and nothing wrong gets past.

Every refusal is a sentence that names the topic, the stamp and the value.
"""

from __future__ import annotations

import math
import re
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from relpose_ros.errors import RelPoseError
from relpose_ros.geometry import so3
from relpose_ros.scanning import image_decoding
from relpose_ros.scanning.image_decoding import ImageError, Region
from relpose_ros.scanning.settings import MAX_NAME_LENGTH
from relpose_ros.views import BoundingBox, Distortion, Intrinsics, RobotPose, View

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy.typing as npt

Kind = Literal["object_view", "image", "compressed", "camera_info", "camera_pose"]
"""relpose_ros/ObjectView; sensor_msgs/Image, CompressedImage and CameraInfo; geometry_msgs/PoseStamped or
PoseWithCovarianceStamped."""

MIN_BOX_SIDE = 8
"""Pixels: a smaller box shows nothing of an object that a network could use."""

MAX_BOX_SIDE = 2**13
"""Pixels: the network's crop is a square on the longer side, however short the other one is, and would take
gigabytes."""

MAX_FULL_SIDE = 2**16
"""Pixels: a larger full image is garbage."""

SHORTEST_FOCAL, LONGEST_FOCAL = 0.05, 1000.0
"""Of a focal length, in sides of the full image: no lens looks so wide or so narrowly, and a matrix in other
units does."""

FURTHEST_CENTRE = 10.0
"""Of a principal point, in sides of the full image from its corner: of a crop it may lie outside."""

QUATERNION_TOLERANCE = 0.01
"""How far from 1 a quaternion's length may be: rounded, not garbage."""

REGION_SCALE = 1.2
"""Part of the picture kept around a box, in units of its longer side: the network's crop is 1.15, and a
margin keeps the crop's interpolation off the region's edge."""

SURROUNDINGS_SCALE = 3.0
"""The same where what stands around the object may match too: of a larger part, which is shrunk to one size,
the object itself would show too little."""


class ViewError(RelPoseError):
    """A message that is no view; the text names the topic, the stamp and the value."""


@dataclass(frozen=True)
class Source:
    """Where a message came from, and when and where its picture was taken."""

    topic: str
    stamp_ns: int
    frame_id: str

    def rejection(self, what: str) -> ViewError:
        """The error that says what was wrong with the message."""
        return ViewError(f"{self.topic}, stamp {stamp_text(self.stamp_ns)}: {what}.")


@dataclass(frozen=True)
class _Picture:
    width: int
    height: int
    decode: Callable[[Region], npt.NDArray[np.uint8]]

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height


DISTORTION_MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
"""By the names of sensor_msgs/distortion_models.hpp, how many numbers each may have. OpenCV's calibration
gives the rational polynomial twelve with a thin prism, and fourteen with a tilted sensor."""

RECTIFIED_TOPIC = re.compile(r"(^|[/_])rect(ified)?([/_]|$)")
"""As image_proc calls them: image_rect, image_rect_color."""


def stamp_text(stamp_ns: int) -> str:
    """A stamp for a person, in seconds with all nine digits."""
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}"


def source_of(message: Any, topic: str) -> Source:
    """What the header of a message says.

    Raises:
        ViewError: The stamp is no time, or the frame no name.
    """
    seconds, nanoseconds = int(message.header.stamp.sec), int(message.header.stamp.nanosec)
    if seconds < 0 or not 0 <= nanoseconds < 1_000_000_000:
        text = f"{topic}: the stamp is no time: sec is {seconds}, nanosec is {nanoseconds}."
        raise ViewError(text)
    source = Source(topic, seconds * 1_000_000_000 + nanoseconds, message.header.frame_id)
    _check_name(source.frame_id, "frame_id", source)
    return source


def object_id_of(message: Any, source: Source, default: str) -> str:
    """The object id of an ObjectView, or the default where it is empty.

    Raises:
        ViewError: It is too long or holds what cannot be printed.
    """
    _check_name(message.object_id, "object_id", source)
    return message.object_id or default


def view_from_object_view(message: Any, source: Source, region_scale: float = REGION_SCALE) -> View:
    """The view in a relpose_ros/ObjectView.

    Args:
        message: The view.
        source: Where it came from.
        region_scale: Which part of the picture is kept, in units of the box's longer side.

    Raises:
        ViewError: A field is wrong, or two of them contradict each other.
    """
    raw, compressed, mask = message.image, message.compressed, message.mask
    if len(raw.data) and len(compressed.data):
        raise source.rejection("both image and compressed are filled: leave one of them empty")
    full = int(message.full_width), int(message.full_height)
    box = _box(message.box)
    with _image_errors_rejected(source):
        picture = _compressed_picture(compressed) if len(compressed.data) else _raw_picture(raw)
        origin = _origin_of_crop(message.crop, picture, box, full, source)
        decode_mask = None
        if len(mask.data):
            decode_mask = partial(image_decoding.decode_mask, mask)
            if image_decoding.raw_size(mask) != picture.size:
                text = f"the mask has {_size_text(image_decoding.raw_size(mask))} pixels"
                raise source.rejection(f"{text}, the picture {_size_text(picture.size)}")
        intrinsics = _intrinsics(message.k, full, source)
        return _view(picture, origin, box, full, intrinsics, decode_mask, source, region_scale)


def view_from_image(
    image: Any,
    info: Any,
    source: Source,
    rectification: str = "auto",
    region_scale: float = REGION_SCALE,
) -> View:
    """The view in a sensor_msgs/Image or CompressedImage and the CameraInfo of the same stamp.

    The box is the camera info's roi; an roi of zeros is the full image. As in image_pipeline, the picture
    shows the full image or the roi alone: its size tells which. One camera info serves the raw picture (K
    and D) and the rectified one (P).

    Args:
        image: The picture.
        info: Its camera info.
        source: Where and when ``image`` was taken.
        rectification: "raw", "rectified", or "auto": as the topic's name says, see `RECTIFIED_TOPIC`.
        region_scale: As in `view_from_object_view`.

    Raises:
        ViewError: A field is wrong, or two of them contradict each other.
    """
    if max(int(info.binning_x), int(info.binning_y)) > 1:
        text = f"binning is {info.binning_x} x {info.binning_y} in camera_info"
        raise source.rejection(f"{text}: publish size and matrix as the picture has them, and a binning of 0")
    with _image_errors_rejected(source):
        picture = _raw_picture(image) if hasattr(image, "encoding") else _compressed_picture(image)
        full = int(info.width), int(info.height)
        if not any(_roi(info.roi)):
            if full == (0, 0):  # nobody calibrated the camera
                full = picture.size
            box = BoundingBox(0.0, 0.0, float(full[0]), float(full[1]))
        elif full == (0, 0):
            raise source.rejection("width and height in camera_info are 0, and its roi is not: fill them in")
        else:
            box = _box(info.roi)
        if picture.size == full:
            origin = (0, 0)
        elif picture.size == (box.width, box.height):
            origin = (int(box.x0), int(box.y0))
        else:
            text = f"the picture has {_size_text(picture.size)} pixels: neither the {_size_text(full)} of "
            raise source.rejection(f"{text}camera_info nor the {box.width:.0f} x {box.height:.0f} of its roi")
        named = RECTIFIED_TOPIC.search(source.topic) is not None
        rectified = rectification == "rectified" or (rectification == "auto" and named)
        if rectified and any(info.p):
            matrix = np.reshape(info.p, (3, 4))[:, :3].ravel()
            intrinsics, distortion = _intrinsics(matrix, full, source), None
        else:
            intrinsics = _intrinsics(info.k, full, source)
            distortion = None if rectified or intrinsics is None else _distortion(info, source)
        view = _view(picture, origin, box, full, intrinsics, None, source, region_scale)
        return replace(view, distortion=distortion)


def robot_pose(message: Any, source: Source, deviations: tuple[float, float]) -> RobotPose:
    """The pose in a geometry_msgs/PoseStamped or PoseWithCovarianceStamped of a camera's optical frame.

    Args:
        message: Its frame_id names the robot's fixed frame.
        source: Where it came from.
        deviations: Standard deviations of position (m) and rotation (rad), for a pose without a covariance or
            with one that is all zero.

    Raises:
        ViewError: It is no pose, or its covariance none.
    """
    if not source.frame_id:
        raise source.rejection("frame_id is empty: it names the robot's frame in which the pose is")
    given = getattr(message.pose, "covariance", None)
    pose = message.pose if given is None else message.pose.pose
    p, q = pose.position, pose.orientation
    position, quaternion = np.array([p.x, p.y, p.z], float), np.array([q.x, q.y, q.z, q.w], float)
    if not np.isfinite(position).all():
        raise source.rejection(f"the position holds what is no number: {position.tolist()}")
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) < QUATERNION_TOLERANCE:  # nan is refused too
        text = f"the orientation {quaternion.tolist()} has length {length:.3g}: a rotation's quaternion has 1"
        raise source.rejection(text)
    covariance = np.zeros((6, 6)) if given is None else np.array(given, float).reshape(6, 6)
    if not np.isfinite(covariance).all():
        raise source.rejection("the covariance holds what is no number")
    covariance = (covariance + covariance.T) / 2
    stated = bool(covariance.any())
    if not stated:
        covariance = np.diag(np.repeat(np.square(deviations), 3))
    elif float(np.linalg.eigvalsh(covariance)[0]) < -1e-9 * float(np.abs(covariance).max()):
        text = f"the covariance with the diagonal {np.diag(covariance).tolist()} is none: it has a negative"
        raise source.rejection(f"{text} eigenvalue; leave it all zero where it is unknown")
    rotation = so3.from_quaternion_xyzw(quaternion)
    return RobotPose(source.frame_id, rotation, position, covariance, stated)


def _view(
    picture: _Picture,
    origin: tuple[int, int],
    box: BoundingBox,
    full: tuple[int, int],
    intrinsics: Intrinsics | None,
    decode_mask: Callable[[Region], npt.NDArray[np.bool_]] | None,
    source: Source,
    region_scale: float,
) -> View:
    """The view, with only that part of the picture that is looked at."""
    if not all(0 < side <= MAX_FULL_SIDE for side in full):
        raise source.rejection(f"the full image cannot have {_size_text(full)} pixels")
    if min(box.width, box.height) < MIN_BOX_SIDE:
        text = f"{_box_text(box)} is too small: an object needs {MIN_BOX_SIDE} x {MIN_BOX_SIDE} pixels"
        raise source.rejection(text)
    if box.x1 > full[0] or box.y1 > full[1]:
        raise source.rejection(f"{_box_text(box)} lies outside the full image of {_size_text(full)} pixels")
    shown = (*origin, origin[0] + picture.width, origin[1] + picture.height)
    if shown[2] > full[0] or shown[3] > full[1]:
        raise source.rejection(
            f"the crop {list(shown)} lies outside the full image of {_size_text(full)} pixels"
        )
    if box.x0 < shown[0] or box.y0 < shown[1] or box.x1 > shown[2] or box.y1 > shown[3]:
        raise source.rejection(f"{_box_text(box)} lies outside the picture, which shows {list(shown)}")
    if max(box.width, box.height) > MAX_BOX_SIDE:
        text = f"{_box_text(box)} is too large: a side has at most {MAX_BOX_SIDE} pixels"
        raise source.rejection(f"{text}; shrink the picture")
    centre_x, centre_y = (box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2
    half = region_scale * max(box.width, box.height) / 2
    x0, y0 = max(math.floor(centre_x - half), shown[0]), max(math.floor(centre_y - half), shown[1])
    x1, y1 = min(math.ceil(centre_x + half), shown[2]), min(math.ceil(centre_y + half), shown[3])
    region = Region(x0 - origin[0], y0 - origin[1], x1 - origin[0], y1 - origin[1])
    return View(
        image=picture.decode(region),
        box=box,
        full_width=full[0],
        full_height=full[1],
        origin=(x0, y0),
        stamp_ns=source.stamp_ns,
        frame_id=source.frame_id,
        intrinsics=intrinsics,
        mask=None if decode_mask is None else decode_mask(region),
    )


def _raw_picture(message: Any) -> _Picture:
    return _Picture(*image_decoding.raw_size(message), partial(image_decoding.decode_image, message))


def _compressed_picture(message: Any) -> _Picture:
    size = image_decoding.compressed_size(message)
    return _Picture(*size, partial(image_decoding.decode_compressed, message))


def _origin_of_crop(
    crop: Any, picture: _Picture, box: BoundingBox, full: tuple[int, int], source: Source
) -> tuple[int, int]:
    """Where the picture of an ObjectView begins in the full image."""
    x, y, width, height = _roi(crop)
    if any((x, y, width, height)):
        if picture.size != (width, height):
            text = f"crop has {width} x {height} pixels, the picture {_size_text(picture.size)}"
            raise source.rejection(text)
        return x, y
    if picture.size == full:
        return 0, 0
    if picture.size == (box.width, box.height):
        return int(box.x0), int(box.y0)
    if not any(full):
        raise source.rejection(
            "full_width and full_height are 0: fill in the size of the camera's full image"
        )
    text = (
        f"the picture has {_size_text(picture.size)} pixels: neither the full image's {_size_text(full)} nor "
    )
    raise source.rejection(
        f"{text}the box's {box.width:.0f} x {box.height:.0f}; fill crop to say what it shows"
    )


@contextmanager
def _image_errors_rejected(source: Source) -> Iterator[None]:
    try:
        yield
    except ImageError as err:
        raise source.rejection(str(err)) from err


def _box(roi: Any) -> BoundingBox:
    x, y, width, height = _roi(roi)
    return BoundingBox(float(x), float(y), float(x + width), float(y + height))


def _roi(roi: Any) -> tuple[int, int, int, int]:
    return int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)


def _size_text(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _box_text(box: BoundingBox) -> str:
    return f"the box [{box.x0:.0f}, {box.y0:.0f}, {box.x1:.0f}, {box.y1:.0f}]"


def _intrinsics(k: Any, size: tuple[int, int], source: Source) -> Intrinsics | None:
    """From a row-major matrix K for pictures of a size; None where it is all zero."""
    matrix = np.asarray(k, np.float64)
    if not np.isfinite(matrix).all():
        raise source.rejection(f"the intrinsic matrix holds what is no number: {matrix.tolist()}")
    if not matrix.any():
        return None
    fx, fy, cx, cy = (float(matrix[index]) for index in (0, 4, 2, 5))
    if fx <= 0 or fy <= 0:
        raise source.rejection(f"the focal length in the intrinsic matrix is {fx}, {fy}: it must be positive")
    if not SHORTEST_FOCAL <= min(fx, fy) / max(size) <= max(fx, fy) / max(size) <= LONGEST_FOCAL:
        text = f"the focal length in the intrinsic matrix is {fx}, {fy} for {_size_text(size)} pixels"
        raise source.rejection(f"{text}: it must be in pixels")
    if max(abs(cx), abs(cy)) > FURTHEST_CENTRE * max(size):
        text = f"the principal point in the intrinsic matrix is {cx}, {cy} for {_size_text(size)} pixels"
        raise source.rejection(f"{text}: it must be in pixels")
    # ROS puts (0, 0) at the first pixel's centre, we at its outer corner.
    return Intrinsics(fx, fy, cx + 0.5, cy + 0.5)


def _distortion(info: Any, source: Source) -> Distortion | None:
    """Of a camera info; None where the lens bends nothing."""
    coefficients, model = np.asarray(info.d, np.float64), str(info.distortion_model)
    if not np.isfinite(coefficients).all():
        raise source.rejection(f"the distortion d holds what is no number: {coefficients.tolist()}")
    # A lens that bends by the angle alone has four zeros; without any numbers nobody calibrated it.
    if not coefficients.any() and not (model == "equidistant" and len(coefficients)):
        return None
    lengths = DISTORTION_MODELS.get(model)
    if lengths is None:
        text = f"the distortion_model is {model[:40]!r}, none of {', '.join(DISTORTION_MODELS)}"
        raise source.rejection(f"{text}: send rectified pictures, with parameter rectification: rectified")
    if len(coefficients) not in lengths:
        text = (
            f"the {model} distortion d has {len(coefficients)} numbers: give {' or '.join(map(str, lengths))}"
        )
        raise source.rejection(text)
    return Distortion(tuple(coefficients.tolist()), equidistant=model == "equidistant")


def _check_name(name: str, what: str, source: Source) -> None:
    if len(name) > MAX_NAME_LENGTH:
        text = f"{what} has {len(name)} characters, more than {MAX_NAME_LENGTH}: {name[:40]!r}..."
        raise source.rejection(text)
    if not name.isprintable():
        raise source.rejection(f"{what} {name!r} holds what cannot be printed")
