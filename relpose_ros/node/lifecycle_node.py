"""The lifecycle node around a scanner: topics and services in, estimates out. It decides nothing by itself.

Callbacks hand messages to the scanner and return; estimates are made and published by one worker thread.
"""

# rclpy is annotated in part only.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import functools
import threading
import time
import traceback
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from copy import copy
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeAlias

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSPolicyKind
from std_srvs.srv import Trigger

from relpose_ros.errors import RelPoseError
from relpose_ros.node.parameters import (
    FORTH,
    changed_settings,
    declare_parameters,
    lifecycle,
    unknown_parameters,
)
from relpose_ros.node.reports import (
    NodeHealth,
    Throttle,
    TopicWatch,
    diagnostic_status,
    missing_images_advice,
    pairing_advice,
    twin_advice,
    type_advice,
)
from relpose_ros.node.topics import (
    DIAGNOSTICS_QOS,
    DIAGNOSTICS_TOPIC,
    INPUTS,
    OUTPUTS,
    OVERRIDABLE,
    RESULT_QOS,
    IncompatibleQos,
    Inputs,
    TopicError,
    require_topics_of_their_own,
)
from relpose_ros.scanning.outgoing import TYPE_NAMES, estimate_message, markers, pose_array
from relpose_ros.scanning.scanner import UNPAIRED_AFTER_S, Scanner
from relpose_ros.scanning.settings import MEANT, SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rclpy.parameter import Parameter

    from relpose_ros.inference.estimator import Estimator
    from relpose_ros.scanning.scanner import Kind, Result, Statistics

    Transition: TypeAlias = Callable[["ScanNode", LifecycleState], TransitionCallbackReturn]

ADAPT_PERIOD_S = 0.2
"""How often the reliability that publishers offer is looked at."""


def _guarded(transition: Transition) -> Transition:
    """A transition that excludes the others and tells what went wrong: rclpy would swallow the exception."""

    @functools.wraps(transition)
    def run(node: ScanNode, state: LifecycleState) -> TransitionCallbackReturn:
        with node.in_transition:
            try:
                return transition(node, state)
            except Exception:
                node.get_logger().error(f"{transition.__name__} failed:\n{traceback.format_exc()}")
                return TransitionCallbackReturn.ERROR

    return run


class ScanNode(LifecycleNode):
    """Views of objects in, camera poses out.

    Topics, services and parameters are those of the README. Configuring loads the weights and makes every
    topic and service; until the node is active, messages are passed over and services answer with a refusal.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Declare the parameters.

        Raises:
            SettingsError: A parameter was given a value that it cannot have.
        """
        # rclpy reads the transition callbacks in its constructor, so this has to exist before.
        self.in_transition = threading.RLock()
        super().__init__("scan_node", **kwargs)
        self._settings = declare_parameters(self)
        self._misspelt = self._tell_unknown_parameters()
        self._advice = self._misspelt
        self._scanner: Scanner | None = None
        self._estimator: Estimator | None = None
        self._worker: ThreadPoolExecutor | None = None
        self._jobs: set[Future[Any]] = set()
        self._jobs_lock = threading.Lock()
        self._estimate_asked = False
        self._telling = threading.Lock()
        """Held while results go out: none goes that was forgotten before a service said so."""
        self._active = False
        self._closing = False
        self._failure = ""
        self._incompatible = IncompatibleQos(self)
        self._inputs = Inputs(self, self._incompatible, self._parameter_overrides, lambda: self._active)
        self._services_of_scan: list[Any] = []
        self._outputs: dict[str, Any] = {}
        self._shown: Result | None = None
        """The last estimate that stands."""
        self._unsaid: list[Result] = []
        """What is to be taken back as soon as somebody can hear it."""
        self._jump: Any = None
        self._longest_callback_s: dict[str, float] = {}
        self._throttle = Throttle()
        self._topic_watch = TopicWatch()
        # A service that waits for an estimate must not hold up the callbacks of images, and what waits for
        # one to be done must not silence the diagnostics.
        self._waiting_group, self._health_group = (MutuallyExclusiveCallbackGroup() for _ in range(2))
        self._diagnostics = self.create_publisher(
            DiagnosticArray, DIAGNOSTICS_TOPIC, copy(DIAGNOSTICS_QOS), qos_overriding_options=OVERRIDABLE
        )
        self._health_timer: Any = None
        self._set_health_timer()
        # Steady, so that it goes on while simulated time stands still.
        self.create_timer(ADAPT_PERIOD_S, self._adapt_inputs, clock=Clock(clock_type=ClockType.STEADY_TIME))
        change_state = self._service_change_state
        change_state.callback = functools.partial(self._on_change_state, change_state.callback)
        self.add_on_set_parameters_callback(self._judge_parameters)
        self.add_post_set_parameters_callback(self._take_parameters)

    def autostart(self) -> None:
        """Configure and activate, where the parameter says so."""
        if self._settings.autostart and self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def close(self, timeout_s: float) -> bool:
        """Begin nothing more, and wait for what is under way.

        Returns:
            Whether nothing is under way any more; False where the time was too short.
        """
        self._closing = True
        self._active = False
        deadline = time.monotonic() + timeout_s
        if not self.in_transition.acquire(timeout=timeout_s):
            return False
        try:
            if self._worker is not None:
                self._worker.shutdown(wait=False, cancel_futures=True)
            under_way = [job for job in self._jobs if not job.cancelled()]
            return not wait(under_way, max(0.0, deadline - time.monotonic())).not_done
        finally:
            self.in_transition.release()

    def finalize(self) -> None:
        """Take the lifecycle to its end, wherever it stands."""
        if self._state_machine.current_state[1] != "finalized":
            self.trigger_shutdown()

    @_guarded
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the weights; make topics, services and the worker."""
        self._failure = ""
        try:
            estimator = self._load_estimator()
        except (RelPoseError, OSError) as err:
            name = self.get_fully_qualified_name()
            how = f"`ros2 param set {name} weights FILE`, {lifecycle(name, *FORTH)}"
            return self._fail(f"{err} Then, or with other weights: {how}.")
        if self._closing:
            return TransitionCallbackReturn.FAILURE
        self._estimator, self._scanner = estimator, Scanner(estimator, self._settings)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="estimate")
        try:
            require_topics_of_their_own(self, self._settings.image_transports)
            self._make_outputs()
            on_message = functools.partial(self._on_message, self._scanner)
            self._inputs.open(self._settings.image_transports, on_message)
        except TopicError as err:
            self._release()
            return self._fail(str(err))
        except (RuntimeError, ParameterException) as err:  # rclpy's own errors are RuntimeErrors
            self._release()
            overridden = any(name.startswith("qos_overrides.") for name in self._parameter_overrides)
            what = "The qos_overrides given are" if overridden else "The topics' names or types are"
            return self._fail(f"{what} refused: {err}. Start the node with others.")
        for name, callback, group in (
            ("~/reset", self._on_reset, None),
            ("~/drop_last_view", self._on_drop_last_view, None),
            ("~/estimate_now", self._on_estimate_now, self._waiting_group),
        ):
            service = self.create_service(Trigger, name, callback, callback_group=group)
            self._services_of_scan.append(service)
        self._watch_clock()
        return super().on_configure(state)

    @_guarded
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take messages and answer services from now on."""
        result = super().on_activate(state)
        self._active = True
        self._submit(self._publish_unsaid)
        self._ask_for_estimate()
        self.get_logger().info(f"Waiting for views on {', '.join(self._inputs.topics)}.")
        return result

    @_guarded
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take nothing more; the views taken so far still get their estimate. They stay held."""
        self._active = False
        while under_way := [job for job in self._jobs if not job.done()]:  # one job may ask for the next
            wait(under_way)
        return super().on_deactivate(state)

    @_guarded
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything that configuring made; once active again, the node takes back what it told."""
        if self._scanner is not None:
            self._scanner.reset("the node was cleaned up")
            self._unsaid += self._scanner.estimate_pending()
        self._release()
        return super().on_cleanup(state)

    @_guarded
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything that configuring made."""
        self._release()
        return super().on_shutdown(state)

    @_guarded
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything, so that the node can be configured again."""
        self._release()
        return super().on_error(state)

    def _fail(self, failure: str) -> TransitionCallbackReturn:
        self._failure = failure
        self.get_logger().error(failure)
        return TransitionCallbackReturn.FAILURE

    def _load_estimator(self) -> Estimator:
        self.get_logger().info(f"Loading {self._settings.weights_path or 'the shipped weights'}.")
        return self._settings.load_estimator()

    def _watch_clock(self) -> None:
        if self._jump is not None:
            self._jump.unregister()
        threshold = JumpThreshold(
            min_forward=None,
            min_backward=Duration(seconds=-self._settings.backward_jump_s),
            on_clock_change=False,
        )
        self._jump = self.get_clock().create_jump_callback(threshold, post_callback=self._on_clock_jump)

    def _make_outputs(self) -> None:
        for name, message_type in OUTPUTS:
            topic = self.resolve_topic_name(name)
            events = PublisherEventCallbacks(
                incompatible_qos=functools.partial(self._on_incompatible_output, topic)
            )
            self._outputs[name] = self.create_lifecycle_publisher(
                message_type,
                name,
                copy(RESULT_QOS),  # rclpy writes the overrides into the profile
                event_callbacks=events,
                qos_overriding_options=OVERRIDABLE,
            )

    def _on_incompatible_output(self, topic: str, event: Any) -> None:
        self._incompatible.note(topic, QoSPolicyKind(event.last_policy_kind), subscribing=False)

    def _adapt_inputs(self) -> None:
        # A transition may take long, and makes or releases the inputs itself.
        if self.in_transition.acquire(blocking=False):
            try:
                if not self._closing:
                    self._inputs.follow_publishers()
            finally:
                self.in_transition.release()

    def _release(self) -> None:
        self._active = False
        with self._jobs_lock:
            worker, self._worker = self._worker, None
        if worker is not None:
            worker.shutdown(wait=True, cancel_futures=True)
        if self._jump is not None:
            self._jump.unregister()
        self._inputs.close()
        for service in self._services_of_scan:
            self.destroy_service(service)
        for publisher in self._outputs.values():
            self.destroy_lifecycle_publisher(publisher)
        self._services_of_scan, self._outputs = [], {}
        self._scanner = self._estimator = self._jump = self._shown = None
        self._jobs = set()
        self._estimate_asked = False
        self._incompatible.clear()
        self._longest_callback_s.clear()

    def _on_message(self, scanner: Scanner, kind: Kind, topic: str, message: Any) -> None:
        if not self._active:
            return
        started = time.perf_counter()
        receipt = scanner.receive(kind, topic, message)
        if scanner.pending():
            self._ask_for_estimate()
        if receipt.rejected:
            line = self._throttle.pass_on(topic, receipt.reason)
            if line is not None:
                self.get_logger().warning(line)
        elif receipt.reason:
            self.get_logger().debug(receipt.reason)
        spent = time.perf_counter() - started
        self._longest_callback_s[topic] = max(spent, self._longest_callback_s.get(topic, 0.0))

    def _on_clock_jump(self, jump: Any) -> None:
        scanner = self._scanner
        if scanner is not None:
            with self._telling:
                scanner.reset(f"the clock jumped backwards by {-jump.delta.nanoseconds * 1e-9:.3f} s")
            if self._active:
                self._ask_for_estimate()

    def _ask_for_estimate(self) -> None:
        """Have the worker estimate what changed. Views that come while it works wait for its next round."""
        if not self._estimate_asked:
            self._estimate_asked = True
            self._submit(self._estimate_pending)

    def _submit(self, job: Callable[[], Any]) -> Future[Any] | None:
        """Queue a job for the worker; None when there is no worker any more."""
        with self._jobs_lock:
            if self._worker is None or self._closing:
                return None
            try:
                future = self._worker.submit(self._run_job, job)
            except RuntimeError:  # The worker was shut down in between.
                return None
            self._jobs = {each for each in self._jobs if not each.done()} | {future}
        return future

    def _run_job(self, job: Callable[[], Any]) -> Any:
        try:
            return job()
        except Exception:
            if not self._closing:
                self.get_logger().error(f"The worker failed:\n{traceback.format_exc()}")
            return None

    def _estimate_pending(self) -> None:
        # Cleared first: a view that arrives from here on asks again.
        self._estimate_asked = False
        scanner = self._scanner
        if scanner is not None and not self._closing and scanner.pending():
            self._estimate(scanner, scanner.estimate_pending)
            # Behind who else waits: an estimate that was asked for comes before the stream of views ends.
            self._ask_for_estimate()

    def _estimate(self, scanner: Scanner, estimate: Callable[[], list[Result]]) -> list[Result]:
        """One round of estimates, published."""
        evidence = self._settings.evidence_settings
        if self._estimator is not None:
            self._estimator.rest_on(evidence)
        results = estimate()
        if self._settings.evidence_settings != evidence:  # set while the estimate was under way
            scanner.require_estimates()
        with self._telling:
            told = [each for each in results if not each.estimate.cameras or scanner.stands(each)]
            self._publish(told)
        return told

    def _estimate_all(self, scanner: Scanner) -> list[Result]:
        """Each scan anew, published as soon as it is estimated."""
        results: list[Result] = []
        for object_id in scanner.objects():
            results += self._estimate(scanner, functools.partial(scanner.estimate_now, object_id))
        return results

    def _publish(self, results: Sequence[Result]) -> None:
        frame, types = self._settings.object_frame, _message_types()
        for result in results:
            if self._closing:
                return
            estimate, scan = result.estimate, result.scan
            shown = self._shown
            self._outputs["~/estimate"].publish(estimate_message(estimate, scan, types, frame))
            if estimate.cameras or shown is None or shown.estimate.object_id == estimate.object_id:
                self._outputs["~/poses"].publish(pose_array(estimate, scan, types, frame))
                self._outputs["~/markers"].publish(markers(estimate, scan, types, frame))
                self._shown = result if estimate.cameras else None
            elif self._scanner is not None and self._scanner.stands(shown):
                # Who joins late hears the last message: that is to be what stands of the object shown.
                again = estimate_message(shown.estimate, shown.scan, types, frame)
                self._outputs["~/estimate"].publish(again)
            done = f"{len(scan.views)} views in {estimate.seconds:.2f} s: " if estimate.cameras else ""
            self.get_logger().info(f"{estimate.object_id}: {done}{estimate.status}")

    def _publish_unsaid(self) -> None:
        unsaid, self._unsaid = self._unsaid, []
        self._publish(unsaid)

    def _on_reset(self, _: Any, response: Any) -> Any:
        scanner = self._scanner_if_active(response)
        if scanner is not None:
            with self._telling:
                forgotten = scanner.reset("a client asked for it")
            self._ask_for_estimate()
            response.success, response.message = True, f"{forgotten} views forgotten."
        return response

    def _on_drop_last_view(self, _: Any, response: Any) -> Any:
        scanner = self._scanner_if_active(response)
        if scanner is not None:
            with self._telling:
                receipt = scanner.drop_last_view()
            self._ask_for_estimate()
            response.success, response.message = receipt.accepted, receipt.reason
        return response

    def _on_estimate_now(self, _: Any, response: Any) -> Any:
        scanner = self._scanner_if_active(response)
        if scanner is None:
            return response

        job = self._submit(functools.partial(self._estimate_all, scanner))
        try:
            results = job.result() if job is not None else None
        except CancelledError:
            results = None
        if results is None:
            response.success, response.message = False, "The node stopped before the estimate was made."
        elif not (estimates := [each.estimate for each in results if each.estimate.cameras]):
            response.success = False
            failures = (scan.failure for scan in scanner.statistics().scans.values())
            response.message = next(filter(None, failures), "No object has two views yet.")
        else:
            response.success = True
            response.message = "; ".join(f"{each.object_id}: {each.status}" for each in estimates)
        return response

    def _scanner_if_active(self, response: Any) -> Scanner | None:
        if not self._active:
            how = lifecycle(self.get_fully_qualified_name(), "activate")
            response.success, response.message = False, f"The node is not active: {how} makes it so."
            return None
        return self._scanner

    def _on_change_state(self, change: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
        # A transition that the state does not allow makes rclpy raise, and the client would wait for ever.
        try:
            return change(request, response)
        except Exception as err:
            self.get_logger().warning(f"The transition {request.transition.id} is refused: {err}")
            response.success = False
            return response

    def _tell_unknown_parameters(self) -> list[str]:
        """Log those that do nothing, and give those back that are a known one misspelt.

        A file that several nodes share names the others' too: nothing that diagnostics should go on about.
        """
        subscribed = {self.resolve_topic_name(each[1]) for each in INPUTS}
        published = {self.resolve_topic_name(each[0]) for each in OUTPUTS} | {DIAGNOSTICS_TOPIC}
        overridable = [
            f"qos_overrides.{topic}.{end}.{policy.name.lower()}"
            for topics, end in ((subscribed, "subscription"), (published, "publisher"))
            for topic in sorted(topics)
            for policy in OVERRIDABLE.policy_kinds
        ]
        # rclpy has no other way to ask for what was given without declaring it.
        unknown = unknown_parameters(self._parameter_overrides, overridable)
        for sentence in unknown:
            self.get_logger().warning(sentence)
        return [sentence for sentence in unknown if MEANT in sentence]

    def _judge_parameters(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        configured = self.get_fully_qualified_name() if self._scanner is not None else ""
        try:
            changed_settings(self._settings, parameters, configured=configured)
        except SettingsError as err:
            return SetParametersResult(successful=False, reason=str(err))
        return SetParametersResult(successful=True)

    def _take_parameters(self, parameters: Sequence[Parameter]) -> None:
        old = self._settings
        self._settings = changed_settings(old, parameters)
        if self._scanner is not None and self._settings != old:
            self._scanner.change_settings(self._settings)
            if self._settings.backward_jump_s != old.backward_jump_s:
                self._watch_clock()
            if self._active:  # fewer views may be left, or other evidence counts
                self._ask_for_estimate()
        if old.diagnostics_period_s != self._settings.diagnostics_period_s:
            self._set_health_timer()

    def _set_health_timer(self) -> None:
        if self._health_timer is not None:
            self.destroy_timer(self._health_timer)
        # Steady, so that it goes on while simulated time stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._health_timer = self.create_timer(
            self._settings.diagnostics_period_s,
            self._look_after_itself,
            callback_group=self._health_group,
            clock=steady,
        )

    def _look_after_itself(self) -> None:
        scanner = self._scanner
        statistics = scanner.statistics() if scanner is not None else None
        told, self._advice = self._advice, [*self._advice_on_topics(statistics), *self._misspelt]
        for sentence in self._advice:
            if sentence not in told:
                self.get_logger().warning(sentence)
        if self._settings.diagnostics:
            self._publish_diagnostics(statistics)

    def _advice_on_topics(self, statistics: Statistics | None) -> list[str]:
        """About what no single message shows."""
        advice = []
        estimates, infos = self.resolve_topic_name(OUTPUTS[0][0]), self.resolve_topic_name("camera_info")
        if self.count_publishers(estimates) > 1:
            advice.append(twin_advice(estimates))
        if self._inputs.of_other_types:
            return [*advice, *(type_advice(*each) for each in self._inputs.of_other_types)]
        if statistics is not None and (statistics.unpaired_s or 0.0) > UNPAIRED_AFTER_S:
            publishers = self._inputs.publishers.get(infos, 0)
            advice.append(pairing_advice(infos, publishers, statistics.frames_apart))
        elif statistics is not None and statistics.images_missing:
            advice += self._advice_on_missing_images()
        return advice

    def _advice_on_missing_images(self) -> list[str]:
        topics = {kind: self.resolve_topic_name(name) for kind, name, _, _ in INPUTS}
        counts = dict(self._inputs.publishers)
        publishers = {
            topics[each]: counts[topics[each]] for each in ("image", "compressed") if topics[each] in counts
        }
        # Views that bring their own camera matrix leave a camera's infos without a use.
        if not any(publishers.values()) and counts.get(topics["object_view"]):
            return []
        return [missing_images_advice(publishers)]

    def _publish_diagnostics(self, statistics: Statistics | None) -> None:
        lost = dict(self._inputs.lost)
        health = NodeHealth(
            state=self._state_machine.current_state[1],
            failure=self._failure,
            publishers=dict(self._inputs.publishers),
            lost=lost,
            longest_callbacks_s=dict(self._longest_callback_s),
            incompatible=self._incompatible.now(),
            troubles=self._topic_watch.troubles(statistics, lost),
            advice=self._advice,
        )
        status = diagnostic_status(self.get_fully_qualified_name(), health, statistics)
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


@functools.cache
def _message_types() -> dict[str, Any]:
    parts = {name: name.split("/") for name in TYPE_NAMES}
    return {name: getattr(import_module(f"{part[0]}.msg"), part[2]) for name, part in parts.items()}
