"""A folder of photographs as a bag: what a camera driver and a detector would have published."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from relpose_ros.captures.folder import load_capture
from relpose_ros.geometry import so3
from relpose_ros.replay.bags import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    OBJECT_VIEW,
    POSE_STAMPED,
    BagError,
    BagWriter,
)
from relpose_ros.replay.ground_truth import GROUND_TRUTH_TOPIC
from relpose_ros.scanning.image_decoding import ImageError, compressed_format, decode_compressed

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from relpose_ros.captures.folder import Photo

Form = Literal["image", "object_view"]

IMAGE_TOPIC = "/image/compressed"
CAMERA_INFO_TOPIC = "/camera_info"
OBJECT_VIEW_TOPIC = "/object_view"
CAMERA_FRAME = "camera_optical_frame"
WORLD_FRAME = "capture_world"
START_NS = 1_000_000_000
"""A capture knows no time. Not zero, which ROS reads as "no stamp"."""
LAST_STAMP_S = 2.0**31
"""A stamp's seconds are an int32."""

logger = logging.getLogger("relpose_ros")


def pack(
    capture: Path,
    output: Path,
    *,
    form: Form = "image",
    views: Sequence[int] | None = None,
    object_id: str = "",
    period_s: float = 1.0,
) -> None:
    """Write a capture folder as a rosbag2 folder, photo after photo.

    Args:
        capture: Folder with cameras.json, images/ and, where known, masks/.
        output: The bag to create.
        form: ``image``: CompressedImage with the file's own bytes, and CameraInfo whose roi is the box;
            standard types only. ``object_view``: ObjectView, with the mask and the object's id.
        views: Positions of the photos to take, in this order; None for all.
        object_id: Name of the object; empty for the folder's name. Only ObjectView carries it.
        period_s: Time between two photos, seconds.

    Raises:
        CaptureError: The capture cannot be read.
        BagError: The output exists, a photo was asked for that is not there, or one is no JPEG or PNG of the
            size that cameras.json says.
    """
    loaded = load_capture(capture)
    chosen = range(len(loaded.photos)) if views is None else views
    if wrong := [k for k in chosen if not 0 <= k < len(loaded.photos)]:
        text = f"{capture} has the photos 0 to {len(loaded.photos) - 1}; there is no photo {wrong[0]}."
        raise BagError(text)
    if not len(chosen):
        raise BagError(f"No photo of {capture} was chosen; leave the choice out to pack all of them.")
    last_s = START_NS / 1e9 + len(chosen) * period_s
    if not (period_s * 1e9 >= 1 and last_s < LAST_STAMP_S):  # nor is either of what is no number
        text = f"The time between two photos is {period_s} s; it must be a nanosecond or more, and the last "
        raise BagError(f"{text}photo's stamp one that ROS can write, before the year 2038.")
    photos = [loaded.photos[k] for k in chosen]
    posed = any(photo.camera_from_world is not None for photo in photos)
    with BagWriter(output) as bag:
        if form == "image":
            bag.add_topic(IMAGE_TOPIC, COMPRESSED_IMAGE)
            bag.add_topic(CAMERA_INFO_TOPIC, CAMERA_INFO)
        else:
            bag.add_topic(OBJECT_VIEW_TOPIC, OBJECT_VIEW)
        if posed:
            bag.add_topic(f"/{GROUND_TRUTH_TOPIC}", POSE_STAMPED)
        for k, photo in enumerate(photos):
            stamp_ns = START_NS + round(k * period_s * 1e9)
            make = _Messages(bag.types, stamp_ns)
            if photo.camera_from_world is not None:
                bag.write(f"/{GROUND_TRUTH_TOPIC}", stamp_ns, make.pose(photo))
            if form == "image":
                bag.write(CAMERA_INFO_TOPIC, stamp_ns, make.camera_info(photo))
                bag.write(IMAGE_TOPIC, stamp_ns, make.compressed(photo))
            else:
                bag.write(OBJECT_VIEW_TOPIC, stamp_ns, make.object_view(photo, object_id or loaded.name))
    logger.info(
        "%s: %d photos of %s%s.", output, len(photos), loaded.name, ", with ground truth" if posed else ""
    )


class _Messages:
    """The messages of one stamp; every field is given, because bag types have no defaults."""

    def __init__(self, types: Mapping[str, Any], stamp_ns: int) -> None:
        self._types = types
        self._stamp_ns = stamp_ns

    def camera_info(self, photo: Photo) -> Any:
        k = _matrix(photo)
        known = photo.intrinsics is not None
        projection = np.hstack([k.reshape(3, 3), np.zeros((3, 1))]).reshape(-1)
        return self._types[CAMERA_INFO](
            header=self._header(CAMERA_FRAME),
            height=photo.height,
            width=photo.width,
            distortion_model="plumb_bob" if known else "",
            d=np.zeros(5 if known else 0),
            k=k,
            r=np.eye(3).reshape(-1) if known else np.zeros(9),
            p=projection,
            binning_x=0,
            binning_y=0,
            roi=self._box(photo),
        )

    def compressed(self, photo: Photo) -> Any:
        try:
            data = photo.file.read_bytes()
        except OSError as err:
            raise BagError(f"{photo.file} cannot be read: {err.strerror}.") from err
        stated_format = compressed_format(data)
        if stated_format is None:
            raise BagError(f"{photo.file} is neither a JPEG nor a PNG, whatever its name: convert it first.")
        message = self._types[COMPRESSED_IMAGE](
            header=self._header(CAMERA_FRAME), format=stated_format, data=np.frombuffer(data, np.uint8)
        )
        try:
            height, width, _ = decode_compressed(message).shape
        except ImageError as err:
            raise BagError(f"{photo.file} is damaged: {err}.") from err
        if (width, height) != (photo.width, photo.height):
            text = f"{photo.file} has {width} x {height} pixels, but its entry in cameras.json says "
            raise BagError(f"{text}{photo.width} x {photo.height}.")
        return message

    def object_view(self, photo: Photo, object_id: str) -> Any:
        mask = photo.read_mask()
        return self._types[OBJECT_VIEW](
            header=self._header(CAMERA_FRAME),
            object_id=object_id,
            image=self._mono8(None),
            compressed=self.compressed(photo),
            mask=self._mono8(None if mask is None else mask.astype(np.uint8) * 255),
            box=self._box(photo),
            crop=self._region(0, 0, 0, 0),
            full_width=photo.width,
            full_height=photo.height,
            k=_matrix(photo),
        )

    def pose(self, photo: Photo) -> Any:
        assert photo.camera_from_world is not None
        rotation = photo.camera_from_world[:, :3]
        x, y, z = (-rotation.T @ photo.camera_from_world[:, 3]).tolist()
        qx, qy, qz, qw = so3.quaternion_xyzw(rotation.T).tolist()
        return self._types[POSE_STAMPED](
            header=self._header(WORLD_FRAME),
            pose=self._types["geometry_msgs/msg/Pose"](
                position=self._types["geometry_msgs/msg/Point"](x=x, y=y, z=z),
                orientation=self._types["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw),
            ),
        )

    def _header(self, frame_id: str) -> Any:
        seconds, nanoseconds = divmod(self._stamp_ns, 1_000_000_000)
        stamp = self._types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        return self._types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)

    def _box(self, photo: Photo) -> Any:
        x0, y0, x1, y1 = (round(edge) for edge in (photo.box.x0, photo.box.y0, photo.box.x1, photo.box.y1))
        return self._region(x0, y0, max(x1 - x0, 1), max(y1 - y0, 1))

    def _region(self, x: int, y: int, width: int, height: int) -> Any:
        return self._types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=x, y_offset=y, height=height, width=width, do_rectify=False
        )

    def _mono8(self, pixels: np.typing.NDArray[np.uint8] | None) -> Any:
        height, width = (0, 0) if pixels is None else pixels.shape
        return self._types["sensor_msgs/msg/Image"](
            header=self._header(CAMERA_FRAME),
            height=height,
            width=width,
            encoding="" if pixels is None else "mono8",
            is_bigendian=0,
            step=width,
            data=np.zeros(0, np.uint8) if pixels is None else pixels.reshape(-1),
        )


def _matrix(photo: Photo) -> np.typing.NDArray[np.float64]:
    """CameraInfo.k, (9,): zero where unknown, the principal point counted from the first pixel's centre."""
    if photo.intrinsics is None:
        return np.zeros(9)
    given = photo.intrinsics
    return np.array([given.fx, 0, given.cx - 0.5, 0, given.fy, given.cy - 0.5, 0, 0, 1], np.float64)
