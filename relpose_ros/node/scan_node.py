"""The scan node as a process: arguments, signals, log and the threads that execute the callbacks."""

# rclpy is annotated in part only.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import threading
import traceback
from contextlib import contextmanager
from typing import TYPE_CHECKING

import rclpy
from rclpy.exceptions import InvalidHandle, ParameterException
from rclpy.executors import MultiThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args, try_shutdown

from relpose_ros.node.lifecycle_node import ScanNode
from relpose_ros.node.reports import LogForwarder
from relpose_ros.scanning.settings import SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

GRACE_S = 1.0
"""How long a signal waits for an estimate, or the loading of weights, that is under way."""


def run_node(args: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; returns the process's exit code.

    To be called in the main thread, where Python lets signals be handled.

    Args:
        args: Arguments after the program's name (``--ros-args ...``); None for those of the process.
    """
    arguments = list(sys.argv[1:] if args is None else args)
    with _stop_signals() as wait_for_signal:
        try:
            unknown = remove_ros_args(arguments)
            if unknown:
                return _refuse(f"{' '.join(unknown)} is no argument of the node: ROS's follow --ros-args.")
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
            node = ScanNode()
        except (SettingsError, ParameterException, RuntimeError) as err:  # most of rclpy's are RuntimeErrors
            try_shutdown()
            return _refuse(str(err))
        with _forwarded_log(node):
            finished = _run(node, wait_for_signal)
    if not finished:
        # An estimate, or the loading of weights, is deep in PyTorch where nothing can interrupt it, and
        # the interpreter would wait for it. Nobody needs its result any more.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return 0


def _refuse(problem: str) -> int:
    print(f"scan_node: {problem}", file=sys.stderr)
    return 1


def _run(node: ScanNode, wait_for_signal: Callable[[], None]) -> bool:
    """Execute the node's callbacks until a signal comes; returns whether nothing of it runs any more."""
    # One may wait for an estimate that a client asked for, another for those before a transition.
    executor = MultiThreadedExecutor(num_threads=3)
    executor.add_node(node)
    executor.create_task(node.autostart)
    stopping = threading.Event()
    spinner = threading.Thread(target=_spin, args=(executor, node, stopping), daemon=True)
    spinner.start()
    wait_for_signal()
    finished = node.close(GRACE_S)
    stopping.set()
    executor.shutdown()
    spinner.join(GRACE_S)
    if finished:
        node.finalize()
    node.destroy_node()
    try_shutdown()
    return finished


def _spin(executor: MultiThreadedExecutor, node: ScanNode, stopping: threading.Event) -> None:
    """Execute callbacks. One that raises is told in the log, and the node goes on."""
    while not stopping.is_set():
        try:
            executor.spin_once()
        except InvalidHandle:
            # Another thread has destroyed a subscription, to make it anew or in a transition, between the
            # executor's listing what to wait for and its waiting: the next turn lists what there is.
            node.get_logger().debug(f"What was to be waited for is gone:\n{traceback.format_exc()}")
        except Exception:
            if not stopping.is_set():
                node.get_logger().error(f"A callback failed:\n{traceback.format_exc()}")


@contextmanager
def _stop_signals() -> Iterator[Callable[[], None]]:
    """SIGINT and SIGTERM as something to wait for, whichever thread they hit.

    A library's threads may be there before we are, so blocking the signals and ``sigwait`` would not do.
    Afterwards both are ignored: a second one, which launch and a terminal like to send, must not turn
    leaving into a failure.
    """
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    with receiver, sender:
        signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        for each in (signal.SIGINT, signal.SIGTERM):
            signal.signal(each, lambda *_: None)

        def wait_for_signal() -> None:
            receiver.recv(1)

        try:
            yield wait_for_signal
        finally:
            for each in (signal.SIGINT, signal.SIGTERM):
                signal.signal(each, signal.SIG_IGN)
            signal.set_wakeup_fd(-1)


@contextmanager
def _forwarded_log(node: ScanNode) -> Iterator[None]:
    """Everything that the package logs goes through the node's logger, and only there."""
    logger = logging.getLogger("relpose_ros")
    forwarder = LogForwarder(node.get_logger())
    level, propagate = logger.level, logger.propagate
    logger.addHandler(forwarder)
    logger.setLevel(logging.DEBUG)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(forwarder)
        logger.setLevel(level)
        logger.propagate = propagate


def main() -> None:
    """Entry point of ``ros2 run relpose_ros scan_node``."""
    sys.exit(run_node())
