"""A scan node in a process of its own, and the other end of its topics in this one."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point, Pose, PoseArray, PoseStamped, PoseWithCovarianceStamped, Quaternion
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from relpose_ros.msg import ObjectView, ScanEstimate
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, RegionOfInterest
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from relpose_ros.network.checkpoint import random_network, write_network

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

PATIENCE_S = 120.0
"""How long something may take before a test gives up: generous, since other work may load the machine. A node
that starts in two seconds takes ten times as long beside eleven others, and longer yet from a cold disk."""

LATCHED = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)

START = "from relpose_ros.node.scan_node import main; main()"

START_WITHOUT_NETWORK = """
import sys, time
from relpose_ros.node import scan_node

loading_s, estimating_s = (float(each) for each in sys.argv[1:3])
del sys.argv[1:3]

class Estimator:
    def rest_on(self, evidence):
        print("resting on", evidence.use, flush=True)

    def estimate(self, scan):
        print("estimating", flush=True)
        time.sleep(estimating_s)
        raise RuntimeError("this estimator cannot estimate")

def load(node):
    print("loading", flush=True)
    time.sleep(loading_s)
    return Estimator()

scan_node.ScanNode._load_estimator = load
scan_node.main()
"""
"""Takes the seconds that loading and an estimate last."""


def wait_until(condition: Callable[[], Any], what: str, patience_s: float = PATIENCE_S) -> Any:
    """The first true answer of ``condition``."""
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        answer = condition()
        if answer:
            return answer
        time.sleep(0.02)
    pytest.fail(f"{what}: not within {patience_s} s")


class NodeProcess:
    """A running scan node and what it printed."""

    def __init__(self, program: str, arguments: Sequence[str], environment: dict[str, str]) -> None:
        self.lines: deque[str] = deque(maxlen=10_000)
        self.process = subprocess.Popen(
            [sys.executable, "-c", program, *arguments],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.lines.extend(iter(self.process.stdout.readline, ""))

    @property
    def log(self) -> str:
        """All of it in one text, which pytest shows whole."""
        return "".join(list(self.lines))

    def told(self, *words: str) -> list[str]:
        """The lines that hold all the words."""
        return [line for line in list(self.lines) if all(word in line for word in words)]

    def wait_for(self, *words: str) -> str:
        def line() -> list[str]:
            found = self.told(*words)
            if not found and self.process.poll() is not None:
                pytest.fail(f"the node ended with {self.process.returncode}:\n{self.log}")
            return found

        return wait_until(line, f"a line with {words}")[0]

    def threads(self) -> int:
        """How many threads the process has."""
        return len(list(Path(f"/proc/{self.process.pid}/task").iterdir()))

    def end(self, how: signal.Signals = signal.SIGINT) -> int:
        """Send a signal and return the exit code."""
        self.process.send_signal(how)
        try:
            return self.process.wait(PATIENCE_S)
        finally:
            self._reader.join(1.0)

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join(1.0)
        assert self.process.stdout is not None
        self.process.stdout.close()


class Graph:
    """This process's node on the graph: publishes views, collects what comes out, calls services."""

    wait_until = staticmethod(wait_until)

    def __init__(self, domain: int) -> None:
        self.context = rclpy.Context()
        self.context.init(domain_id=domain)
        self.node = rclpy.create_node("tester", context=self.context, enable_rosout=False)
        self._publishers: dict[tuple[str, ReliabilityPolicy], Any] = {}
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()
        self.estimates: list[ScanEstimate] = []
        self.taken_back: list[ScanEstimate] = []
        self.node.create_subscription(ScanEstimate, "/scan_node/estimate", self._sort, LATCHED)
        self.poses = self.collect(PoseArray, "/scan_node/poses")
        self.markers = self.collect(MarkerArray, "/scan_node/markers")
        self._diagnostics = self.collect(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join(PATIENCE_S)
        self.node.destroy_node()
        self.context.shutdown()

    def _sort(self, estimate: ScanEstimate) -> None:
        (self.estimates if estimate.cameras else self.taken_back).append(estimate)

    def collect(self, message_type: type, topic: str, qos: QoSProfile = LATCHED) -> list[Any]:
        messages: list[Any] = []
        self.node.create_subscription(message_type, topic, messages.append, qos)
        return messages

    def publisher(self, message_type: type, topic: str, reliability: ReliabilityPolicy) -> Any:
        """A publisher that the node listens to: our knowing of the node is not enough, it has to know us."""
        key = (topic, reliability)
        if key not in self._publishers:
            qos = QoSProfile(depth=100, reliability=reliability)
            self._publishers[key] = self.node.create_publisher(message_type, topic, qos)
            count = str(sum(topic == other for other, _ in self._publishers))
            wait_until(
                lambda: self.diagnostic(f"{topic} publishers") == count, f"the node to know of {topic}"
            )
        return self._publishers[key]

    def publish(self, topic: str, *messages: Any, reliability: Any = ReliabilityPolicy.RELIABLE) -> None:
        publisher = self.publisher(type(messages[0]), topic, reliability)
        for message in messages:
            publisher.publish(message)

    def publish_until(
        self, condition: Callable[[], Any], what: str, publish: Callable[[float], None]
    ) -> None:
        """Publish for ten seconds, eleven, ... until a condition holds: best effort loses some."""
        stamps = itertools.count(10)

        def holds() -> bool:
            publish(float(next(stamps)))
            time.sleep(0.1)
            return bool(condition())

        wait_until(holds, what)

    def call(self, service_type: type, name: str, **request: Any) -> Any:
        client = self.node.create_client(service_type, name)
        try:
            wait_until(client.service_is_ready, f"the service {name}")
            future = client.call_async(service_type.Request(**request))
            wait_until(future.done, f"an answer of {name}")
            return future.result()
        finally:
            self.node.destroy_client(client)

    def trigger(self, name: str) -> Any:
        return self.call(Trigger, f"/scan_node/{name}")

    def state(self) -> str:
        return str(self.call(GetState, "/scan_node/get_state").current_state.label)

    def change_state(self, transition: int) -> bool:
        request = ChangeState.Request()
        request.transition.id = transition
        return bool(self.call(ChangeState, "/scan_node/change_state", transition=request.transition).success)

    def set_parameter(self, name: str, value: Any) -> tuple[bool, str]:
        parameter = Parameter(name, value=value).to_parameter_msg()
        (result,) = self.call(SetParameters, "/scan_node/set_parameters", parameters=[parameter]).results
        return result.successful, result.reason

    def descriptor(self, name: str) -> Any:
        return self.call(DescribeParameters, "/scan_node/describe_parameters", names=[name]).descriptors[0]

    def diagnostics(self) -> Any:
        """The next status that the node sends."""
        self._diagnostics.clear()
        return wait_until(lambda: list(self._diagnostics), "diagnostics")[0].status[0]

    def set_clock(self, seconds: int) -> None:
        """Publish simulated time until the node follows it."""
        publisher = self.node.create_publisher(Clock, "/clock", 1)

        def followed() -> bool:
            publisher.publish(Clock(clock=Time(sec=seconds)))
            return bool(self._diagnostics and self._diagnostics[-1].header.stamp.sec == seconds)

        wait_until(followed, f"the node's clock to be {seconds} s")
        self.node.destroy_publisher(publisher)

    def diagnostic(self, key: str) -> str | None:
        return {each.key: each.value for each in self.diagnostics().values}.get(key)

    def count(self, topic: str, what: str) -> int:
        """Messages that the node received, used or rejected on a topic since it was configured."""
        return int(self.diagnostic(f"{topic} {what}") or 0)

    def parameter(self, name: str) -> Any:
        values = self.call(GetParameters, "/scan_node/get_parameters", names=[name]).values
        return parameter_value_to_python(values[0])

    def estimate_of(self, object_id: str, views: int) -> ScanEstimate:
        """The first estimate of so many views of an object."""

        def found() -> list[ScanEstimate]:
            of = [each for each in list(self.estimates) if each.object_id == object_id]
            return [each for each in of if len(each.cameras) == views]

        return wait_until(found, f"an estimate of {views} views of {object_id}")[0]

    def forget(self) -> None:
        """Have the node forget its views, and this end what came of them."""
        assert self.trigger("reset").success
        for each in (self.estimates, self.taken_back, self.poses, self.markers):
            each.clear()


class Make:
    """Messages of one camera, whose box is the middle of its picture."""

    @staticmethod
    def header(stamp_s: float) -> Header:
        nanoseconds = round(stamp_s * 1e9)
        stamp = Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return Header(stamp=stamp, frame_id="camera_optical")

    @staticmethod
    def picture(stamp_s: float, width: int = 64, height: int = 48) -> np.ndarray:
        """Noise, another one each time: what is on it does not matter here."""
        generator = np.random.default_rng(round(stamp_s * 1000))
        return generator.integers(0, 256, (height, width, 3), dtype=np.uint8)

    @classmethod
    def image(cls, stamp_s: float, width: int = 64, height: int = 48) -> Image:
        message = Image(
            header=cls.header(stamp_s),
            height=height,
            width=width,
            encoding="rgb8",
            is_bigendian=0,
            step=3 * width,
        )
        message.data.frombytes(cls.picture(stamp_s, width, height).tobytes())
        return message

    @classmethod
    def compressed(cls, stamp_s: float) -> CompressedImage:
        message = CompressedImage(header=cls.header(stamp_s), format="rgb8; jpeg compressed bgr8")
        message.data.frombytes(cv2.imencode(".jpg", cls.picture(stamp_s))[1].tobytes())
        return message

    @classmethod
    def camera_info(cls, stamp_s: float, width: int = 64, height: int = 48) -> CameraInfo:
        f = 1.2 * width
        box = RegionOfInterest(
            x_offset=width // 4, y_offset=height // 4, width=width // 2, height=height // 2
        )
        return CameraInfo(
            header=cls.header(stamp_s),
            width=width,
            height=height,
            distortion_model="plumb_bob",
            k=[f, 0.0, width / 2, 0.0, f, height / 2, 0.0, 0.0, 1.0],
            roi=box,
        )

    @classmethod
    def camera_pose(
        cls, stamp_s: float, *, covariance: bool = False
    ) -> PoseStamped | PoseWithCovarianceStamped:
        """On a circle, another place each time."""
        pose = Pose(
            position=Point(x=math.cos(stamp_s), y=math.sin(stamp_s), z=0.5),
            orientation=Quaternion(x=0.0, y=0.0, z=math.sin(stamp_s / 2), w=math.cos(stamp_s / 2)),
        )
        header = cls.header(stamp_s)
        header.frame_id = "base"
        if not covariance:
            return PoseStamped(header=header, pose=pose)
        message = PoseWithCovarianceStamped(header=header)
        message.pose.pose = pose
        message.pose.covariance = np.diag(np.repeat([1e-6, 1e-4], 3)).reshape(-1)
        return message

    @classmethod
    def object_view(cls, stamp_s: float, object_id: str) -> ObjectView:
        info = cls.camera_info(stamp_s)
        return ObjectView(
            header=cls.header(stamp_s),
            object_id=object_id,
            image=cls.image(stamp_s),
            box=info.roi,
            full_width=info.width,
            full_height=info.height,
            k=info.k,
        )


@pytest.fixture(scope="session")
def make() -> type[Make]:
    return Make


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights that know nothing: what they say does not matter here."""
    path: Path = tmp_path_factory.mktemp("weights") / "random.safetensors"
    write_network(random_network("compact", seed=0), path)
    return path


@pytest.fixture(scope="module")
def domain() -> Iterator[int]:
    """A ROS graph of the module's own on this machine, for this process and those it starts."""
    number = random.SystemRandom().randint(1, 101)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("PYTHONUNBUFFERED", "1")
        patch.delenv("ROS_STATIC_PEERS", raising=False)
        yield number


@contextlib.contextmanager
def node_processes() -> Iterator[Callable[..., NodeProcess]]:
    """A function that starts nodes; they are ended whatever became of the tests."""
    started: list[NodeProcess] = []

    def start(*arguments: str, program: str = START) -> NodeProcess:
        started.append(NodeProcess(program, arguments, dict(os.environ)))
        return started[-1]

    try:
        yield start
    finally:
        for each in started:
            each.kill()


@pytest.fixture
def start(domain: int) -> Iterator[Callable[..., NodeProcess]]:
    """Starts nodes with the given arguments."""
    with node_processes() as start:
        yield start


@pytest.fixture
def start_without_network(start: Callable[..., NodeProcess]) -> Callable[..., NodeProcess]:
    """Starts nodes whose estimator only takes its time, and quickly, because they do without PyTorch."""

    def start_without_network(
        *parameters: str,
        loading_s: float = 0.0,
        estimating_s: float = 0.0,
        files: Sequence[Path] = (),
        remapping: dict[str, str] | None = None,
    ) -> NodeProcess:
        given = [word for each in parameters for word in ("-p", each)]
        given += [word for name, topic in (remapping or {}).items() for word in ("-r", f"{name}:={topic}")]
        given += [word for each in files for word in ("--params-file", str(each))]
        times = (str(loading_s), str(estimating_s))
        return start(*times, "--ros-args", *given, program=START_WITHOUT_NETWORK)

    return start_without_network


@pytest.fixture(scope="module")
def running(domain: int, weights: Path) -> Iterator[NodeProcess]:
    """One node for a whole module: most of its start is PyTorch's."""
    parameters = (f"weights:={weights}", "threads:=1", "diagnostics_period_s:=0.1")
    with node_processes() as start:
        node = start("--ros-args", *(word for each in parameters for word in ("-p", each)))
        node.wait_for("Waiting for views")
        yield node


@pytest.fixture(scope="module")
def graph(domain: int) -> Iterator[Graph]:
    """Shared by the tests of one node."""
    with contextlib.closing(Graph(domain)) as graph:
        yield graph


@pytest.fixture
def new_graph(domain: int) -> Iterator[Graph]:
    """Knows of no node that is gone."""
    with contextlib.closing(Graph(domain)) as graph:
        yield graph
