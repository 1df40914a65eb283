"""Messages of both libraries, and an estimator whose answers are known."""

from __future__ import annotations

import array
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from relpose_ros.estimates import CameraPose, Mode, PairRotation, ScanEstimate, Verdict
from relpose_ros.geometry import so3
from relpose_ros.scanning.outgoing import TYPE_NAMES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from relpose_ros.views import Scan

MESSAGES = Path(__file__).resolve().parents[2] / "msg"

INCOMING_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/RegionOfInterest",
    "relpose_ros/msg/ObjectView",
)


@dataclass(frozen=True)
class MessageFactory:
    """Builds messages of one library from plain values; everything not given is what makes a good message."""

    name: str
    types: Mapping[str, Callable[..., Any]]
    sequence: Callable[[bytes], Any]
    """What the library holds bytes in."""
    serialise: Callable[[Any, str], bytes]
    """A message of a type as CDR."""

    def header(self, stamp: float | tuple[int, int] = 1.0, frame_id: str = "camera") -> Any:
        seconds, nanoseconds = stamp if isinstance(stamp, tuple) else (int(stamp), round(stamp % 1 * 1e9))
        time = self.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        return self.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)

    def roi(self, x: int = 0, y: int = 0, width: int = 0, height: int = 0) -> Any:
        return self.types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=x, y_offset=y, width=width, height=height, do_rectify=False
        )

    def image(
        self,
        data: bytes = b"",
        width: int = 0,
        height: int = 0,
        encoding: str = "rgb8",
        step: int = 0,
        is_bigendian: int = 0,
        **header: Any,
    ) -> Any:
        return self.types["sensor_msgs/msg/Image"](
            header=self.header(**header),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=is_bigendian,
            step=step,
            data=self.sequence(data),
        )

    def rgb(self, pixels: np.ndarray, **header: Any) -> Any:
        height, width, channels = pixels.shape
        return self.image(pixels.tobytes(), width, height, "rgb8", width * channels, **header)

    def compressed(self, data: bytes = b"", stated_format: str = "jpeg", **header: Any) -> Any:
        return self.types["sensor_msgs/msg/CompressedImage"](
            header=self.header(**header), format=stated_format, data=self.sequence(data)
        )

    def camera_info(
        self,
        width: int,
        height: int,
        roi: tuple[int, int, int, int] = (0, 0, 0, 0),
        k: Any = (500, 0, 320, 0, 500, 240, 0, 0, 1),
        binning: tuple[int, int] = (0, 0),
        **header: Any,
    ) -> Any:
        return self.types["sensor_msgs/msg/CameraInfo"](
            header=self.header(**header),
            height=height,
            width=width,
            distortion_model="plumb_bob",
            d=np.zeros(5) if self.name == "rosbags" else [0.0] * 5,
            k=np.array(k, np.float64),
            r=np.eye(3).reshape(-1),
            p=np.zeros(12),
            binning_x=binning[0],
            binning_y=binning[1],
            roi=self.roi(*roi),
        )

    def camera_pose(
        self,
        position: tuple[float, float, float] = (0.0, 0.0, 0.0),
        orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
        covariance: np.ndarray | None = None,
        frame_id: str = "base",
        **header: Any,
    ) -> Any:
        """With a covariance a PoseWithCovarianceStamped, else a PoseStamped."""
        point, quaternion = (self.types[f"geometry_msgs/msg/{name}"] for name in ("Point", "Quaternion"))
        pose = self.types["geometry_msgs/msg/Pose"](
            position=point(**dict(zip("xyz", position, strict=True))),
            orientation=quaternion(**dict(zip("xyzw", orientation, strict=True))),
        )
        stamped = self.header(frame_id=frame_id, **header)
        if covariance is None:
            return self.types["geometry_msgs/msg/PoseStamped"](header=stamped, pose=pose)
        return self.types["geometry_msgs/msg/PoseWithCovarianceStamped"](
            header=stamped,
            pose=self.types["geometry_msgs/msg/PoseWithCovariance"](
                pose=pose, covariance=np.array(covariance, np.float64).reshape(-1)
            ),
        )

    def object_view(
        self,
        image: Any = None,
        box: tuple[int, int, int, int] = (8, 8, 16, 16),
        full: tuple[int, int] = (40, 32),
        crop: tuple[int, int, int, int] = (0, 0, 0, 0),
        object_id: str = "mug",
        compressed: Any = None,
        mask: Any = None,
        k: Any = (0.0,) * 9,
        **header: Any,
    ) -> Any:
        if image is None and compressed is None:
            image = self.rgb(np.zeros((32, 40, 3), np.uint8))
        return self.types["relpose_ros/msg/ObjectView"](
            header=self.header(**header),
            object_id=object_id,
            image=image if image is not None else self.image(),
            compressed=compressed if compressed is not None else self.compressed(),
            mask=mask if mask is not None else self.image(),
            box=self.roi(*box),
            crop=self.roi(*crop),
            full_width=full[0],
            full_height=full[1],
            k=np.array(k, np.float64),
        )


def rosbags_factory() -> MessageFactory:
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    own = {}
    for path in sorted(MESSAGES.glob("*.msg")):
        own.update(typesys.get_types_from_msg(path.read_text(), f"relpose_ros/msg/{path.stem}"))
    store.register(own)
    return MessageFactory(
        "rosbags",
        store.types,
        lambda data: np.frombuffer(data, np.uint8),
        lambda message, name: bytes(store.serialize_cdr(message, name)),
    )


def rclpy_factory() -> MessageFactory:
    types = {}
    for name in {*TYPE_NAMES, *INCOMING_TYPES}:
        package, _, message = name.split("/")
        module = pytest.importorskip(f"{package}.msg", reason="the ROS messages are not installed")
        types[name] = getattr(module, message)
    serialise = pytest.importorskip("rclpy.serialization").serialize_message
    return MessageFactory(
        "rclpy", types, lambda data: array.array("B", data), lambda message, _: serialise(message)
    )


@pytest.fixture(params=["rosbags", "rclpy"], scope="session")
def messages(request: pytest.FixtureRequest) -> MessageFactory:
    """Messages of a bag, and of the ROS graph where ROS is installed."""
    return rosbags_factory() if request.param == "rosbags" else rclpy_factory()


@pytest.fixture(scope="session")
def bag_messages() -> MessageFactory:
    """Messages of a bag, where it does not matter whose they are."""
    return rosbags_factory()


@pytest.fixture(scope="session")
def graph_messages() -> MessageFactory:
    """Messages of the ROS graph; skips the test where ROS is not installed."""
    return rclpy_factory()


def look_from(azimuth: float) -> np.ndarray:
    """object_from_camera of a camera that looks at the origin from an azimuth in rad."""
    return so3.exp([0.0, azimuth, 0.0])


def estimate_of(scan: Scan, azimuths: list[float], ambiguous: bool = False) -> ScanEstimate:
    """An estimate with cameras on a circle around the object."""
    rotations = [look_from(azimuth) for azimuth in azimuths]
    cameras = tuple(
        CameraPose(k, rotation, rotation @ np.array([0.0, 0.0, -1.0]), np.eye(6) * (k + 1))
        for k, rotation in enumerate(rotations)
    )
    pairs = tuple(
        PairRotation(
            i=i,
            j=j,
            camera_j_from_camera_i=rotations[j].T @ rotations[i],
            covariance=np.diag([1.0, 2.0, 3.0]),
            entropy=-3.5,
            probability_within_15_deg=0.9 - 0.1 * i,
            modes=(
                Mode(rotations[j].T @ rotations[i], 0.7, np.eye(3)),
                Mode(rotations[i], 0.3, 2 * np.eye(3)),
            ),
            ambiguous=ambiguous and (i, j) == (0, 1),
            ambiguity_angle=np.pi if ambiguous and (i, j) == (0, 1) else 0.0,
            solution_probability=0.8,
            solution_angle=0.1,
        )
        for i in range(len(rotations))
        for j in range(i + 1, len(rotations))
    )
    return ScanEstimate(
        object_id=scan.object_id,
        cameras=cameras,
        pairs=pairs,
        score=12.5,
        scale_known=False,
        calibrated=True,
        verdict=Verdict.ONE_MORE_VIEW,
        weakest_pair=len(pairs) - 1,
        status="one more view",
        seconds=0.25,
    )


@dataclass
class CircleEstimator:
    """Knows from which azimuth each view was taken: by its stamp in seconds, in degrees."""

    azimuth_deg: Callable[[float], float] = lambda stamp: 10.0 * stamp
    scans: list[Scan] = field(default_factory=list)

    def estimate(self, scan: Scan) -> ScanEstimate:
        self.scans.append(scan)
        azimuths = [np.radians(self.azimuth_deg(view.stamp_ns * 1e-9)) for view in scan.views]
        return estimate_of(scan, azimuths)


@pytest.fixture
def quiet_log() -> Iterator[None]:
    """Keeps the log of thousands of messages out of memory."""
    logger = logging.getLogger("relpose_ros")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    yield
    logger.setLevel(level)


@pytest.fixture
def circle_estimator() -> type[CircleEstimator]:
    return CircleEstimator


@pytest.fixture
def make_estimate() -> Callable[..., ScanEstimate]:
    return estimate_of
