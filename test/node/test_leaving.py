"""How the node starts badly, and how it leaves: a process for each case, most of them without the network."""

from __future__ import annotations

import signal
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy
from relpose_ros.msg import ScanEstimate
from sensor_msgs.msg import Image

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

BOTH = pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
FOR_EVER_S = 1000.0


@BOTH
def test_a_signal_while_waiting(how: signal.Signals, start_without_network: Callable[..., Any]) -> None:
    node = start_without_network()
    node.wait_for("Waiting for views")
    assert node.end(how) == 0
    assert not node.told("Traceback"), node.log


@BOTH
def test_a_signal_while_loading(how: signal.Signals, start_without_network: Callable[..., Any]) -> None:
    node = start_without_network(loading_s=FOR_EVER_S)
    node.wait_for("loading")
    assert node.end(how) == 0
    assert not node.told("Traceback"), node.log


@BOTH
def test_a_signal_during_an_estimate(
    how: signal.Signals, start_without_network: Callable[..., Any], new_graph: Any, make: Any
) -> None:
    node = start_without_network("diagnostics_period_s:=0.1", estimating_s=FOR_EVER_S)
    node.wait_for("Waiting for views")
    new_graph.publish("/object_view", *(make.object_view(10.0 + k, "mug") for k in range(2)))
    node.wait_for("estimating")
    assert node.end(how) == 0
    assert not node.told("Traceback"), node.log


def test_a_clock_that_jumps_back_resets_the_scans(
    start_without_network: Callable[..., Any], new_graph: Any, make: Any
) -> None:
    """And, in the same process, an estimator that fails, and a QoS override that fits no publisher."""
    node = start_without_network(
        "use_sim_time:=true",
        "diagnostics_period_s:=0.1",
        "qos_overrides./image.subscription.reliability:=reliable",
    )
    node.wait_for("Waiting for views")
    new_graph.set_clock(100)
    new_graph.publish("/object_view", *(make.object_view(100.0 + k, "mug") for k in range(2)))
    node.wait_for("ERROR", "'mug'", "cannot estimate")
    assert new_graph.diagnostic("failed estimates") == "1"
    assert new_graph.diagnostic("mug views") == "2"
    answer = new_graph.trigger("estimate_now")
    assert (answer.success, answer.message) == (
        False,
        "The estimate of 'mug' from 2 views failed: this estimator cannot estimate.",
    )
    assert "cannot estimate" in new_graph.diagnostics().message
    new_graph.set_clock(50)
    node.wait_for("the clock jumped backwards by 50.000 s")
    new_graph.wait_until(lambda: new_graph.diagnostic("mug views") is None, "a scan that is forgotten")
    assert new_graph.set_parameter("backward_jump_s", 20.0)[0]
    new_graph.publish("/object_view", *(make.object_view(50.0 + k, "mug") for k in range(2)))
    new_graph.wait_until(lambda: new_graph.diagnostic("mug views") == "2", "a scan that begins anew")
    new_graph.set_clock(40)
    new_graph.set_clock(10)
    node.wait_for("the clock jumped backwards by 30.000 s")
    assert not node.told("the clock jumped backwards by 10.000 s"), node.log

    new_graph.node.create_publisher(
        Image, "/image", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    node.wait_for("WARN", "/image", "qos_overrides./image.subscription.reliability", "best_effort")
    advice = new_graph.wait_until(lambda: new_graph.diagnostic("/image QoS"), "the same in the diagnostics")
    assert "best_effort" in advice
    impatient = QoSProfile(depth=1, deadline=Duration(seconds=1))
    new_graph.collect(ScanEstimate, "/scan_node/estimate", impatient)
    node.wait_for("WARN", "/scan_node/estimate", "deadline")
    assert node.end() == 0


def test_without_autostart_it_waits_for_a_manager(
    start_without_network: Callable[..., Any], new_graph: Any
) -> None:
    node = start_without_network("autostart:=false", "image_transports:=[compressed]", "diagnostics:=false")
    assert new_graph.state() == "unconfigured"
    assert new_graph.change_state(Transition.TRANSITION_CONFIGURE)
    assert new_graph.state() == "inactive"
    assert not new_graph.trigger("reset").success
    assert new_graph.node.count_subscribers("/image/compressed") == 1
    assert new_graph.node.count_subscribers("/image") == 0
    assert new_graph.change_state(Transition.TRANSITION_INACTIVE_SHUTDOWN)
    assert new_graph.state() == "finalized"
    assert node.end() == 0


@pytest.mark.parametrize("override", ["reliability:=relyable", "depth:=deep", "depth:=-3"])
def test_a_qos_override_that_cannot_be_is_told(
    override: str, start_without_network: Callable[..., Any], new_graph: Any
) -> None:
    node = start_without_network(f"qos_overrides./image.subscription.{override}")
    node.wait_for("ERROR", "The qos_overrides given are refused")
    assert not node.told("Traceback"), node.log
    assert "qos_overrides" in new_graph.diagnostics().message
    assert new_graph.state() == "unconfigured"
    assert new_graph.node.count_publishers("/scan_node/estimate") == 0, "what was made is released"
    assert node.end() == 0


@pytest.mark.parametrize(
    ("remapping", "words"),
    [
        (
            {"image": "/cam", "image/compressed": "/cam"},
            "image and image/compressed are both remapped to /cam, where one type alone can be",
        ),
        (
            {"object_view": "/scan_node/estimate"},
            "object_view and ~/estimate are both remapped to /scan_node/estimate",
        ),
    ],
)
def test_two_inputs_on_one_topic_are_told(
    remapping: dict[str, str], words: str, start_without_network: Callable[..., Any], new_graph: Any
) -> None:
    node = start_without_network(remapping=remapping)
    node.wait_for("ERROR", words)
    assert words in new_graph.diagnostics().message
    assert new_graph.state() == "unconfigured"
    assert node.end() == 0


def test_a_transport_that_is_not_asked_for_takes_no_topic(start_without_network: Callable[..., Any]) -> None:
    remapping = {"image": "/cam", "image/compressed": "/cam"}
    node = start_without_network("image_transports:=[raw]", remapping=remapping)
    node.wait_for("Waiting for views", "/cam")
    assert node.end() == 0


def test_diagnostics_go_on_while_a_transition_waits_for_an_estimate(
    start_without_network: Callable[..., Any], new_graph: Any, make: Any
) -> None:
    node = start_without_network("diagnostics_period_s:=0.1", estimating_s=FOR_EVER_S)
    node.wait_for("Waiting for views")
    new_graph.publish("/object_view", *(make.object_view(10.0 + k, "mug") for k in range(2)))
    node.wait_for("estimating")
    client = new_graph.node.create_client(ChangeState, "/scan_node/change_state")
    assert client.wait_for_service(60)
    request = ChangeState.Request()
    request.transition.id = Transition.TRANSITION_DEACTIVATE
    answer = client.call_async(request)
    for _ in range(20):
        new_graph.diagnostics()
    assert not answer.done()
    assert node.end() == 0


def test_a_misspelt_parameter_is_told(
    start_without_network: Callable[..., Any], new_graph: Any, tmp_path: Path
) -> None:
    file = tmp_path / "params.yaml"
    file.write_text(
        "/**:\n  ros__parameters:\n    max_view: 3\n    use_sim_time: false\n"
        "    qos_overrides: {/image: {subscription: {depht: 7}}}\n"
        "other_node:\n  ros__parameters: {exposure: 1}\n"
    )
    node = start_without_network("evidense:=network", "image_transports:=[raw]", files=[file])
    node.wait_for("Waiting for views")
    for given, meant in (
        ("evidense", "evidence"),
        ("max_view", "max_views"),
        ("qos_overrides./image.subscription.depht", "qos_overrides./image.subscription.depth"),
    ):
        assert node.told("WARN", f"no parameter {given} (did you mean {meant}?)"), node.log
    assert len(node.told("no parameter")) == 3, node.log
    assert "no parameter" in new_graph.diagnostics().message
    assert node.end() == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--ros-args", "-p", "max_views:=9"], ["max_views", "9"]),
        (["--ros-args", "-p", "keep:=some"], ["keep", "'some'", "spread"]),
        (["--ros-args", "-p", "backward_jump_s:=soon"], ["backward_jump_s", "soon"]),
        (["--ros-args", "-p", "image_transports:=[]"], ["image_transports"]),
        (["--ros-args", "-p", "qos_overrides./diagnostics.publisher.depth:=deep"], ["qos_overrides", "deep"]),
        (["--help-me"], ["--help-me", "--ros-args"]),
        (["--ros-args", "--params-file", "nowhere.yaml"], ["nowhere.yaml"]),
    ],
)
def test_a_wrong_argument_is_one_sentence(
    arguments: list[str], words: list[str], start: Callable[..., Any]
) -> None:
    node = start(*arguments)
    assert node.process.wait(60.0) != 0
    node.kill()
    (line,) = node.lines
    assert all(word in line for word in words)


def test_the_node_module_leaves_pytorch_alone() -> None:
    """It takes seconds to import, in which a signal would end the process with a traceback."""
    program = "import sys, relpose_ros.node.scan_node; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
