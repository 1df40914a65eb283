"""The node's topics: names, types, quality of service, and subscriptions that follow their publishers."""

# rclpy is annotated in part only.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import functools
from copy import copy
from typing import TYPE_CHECKING, Any

from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from visualization_msgs.msg import MarkerArray

from relpose_ros.errors import RelPoseError
from relpose_ros.msg import ObjectView, ScanEstimate
from relpose_ros.node.reports import Throttle, loss_advice, qos_advice

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator

    from rclpy.node import Node

    from relpose_ros.scanning.scanner import Kind

BURST = 50
"""Messages that a subscription keeps while the callbacks are busy with others."""
LOSS_REPEAT_AFTER_S = 60.0
"""Lost messages are told this often: a scan can do with some of a camera's frames."""

INPUTS: tuple[tuple[Kind, str, Any, str], ...] = (
    ("object_view", "object_view", ObjectView, ""),
    ("image", "image", Image, "raw"),
    ("compressed", "image/compressed", CompressedImage, "compressed"),
    ("camera_info", "camera_info", CameraInfo, ""),
    ("camera_pose", "camera_pose", PoseStamped, ""),
    ("camera_pose", "camera_pose_with_covariance", PoseWithCovarianceStamped, ""),
)
"""Kind, topic, type, and the image transport that must be asked for (empty: always there)."""

OUTPUTS: tuple[tuple[str, Any], ...] = (
    ("~/estimate", ScanEstimate),
    ("~/poses", PoseArray),
    ("~/markers", MarkerArray),
)

INPUT_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=BURST,
    reliability=ReliabilityPolicy.RELIABLE,  # until a best effort publisher joins
    durability=DurabilityPolicy.VOLATILE,
)
RESULT_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,  # with transient local: matches every subscription
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
DIAGNOSTICS_TOPIC = "/diagnostics"
DIAGNOSTICS_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10)
OVERRIDABLE = QoSOverridingOptions(
    (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY)
)
# A read-only parameter could not tell a reliability that follows the publishers.
OVERRIDABLE_BUT_RELIABILITY = QoSOverridingOptions(
    [each for each in OVERRIDABLE.policy_kinds if each != QoSPolicyKind.RELIABILITY]
)


class TopicError(RelPoseError):
    """Names of topics that cannot be as they are remapped."""


def require_topics_of_their_own(node: Node, transports: Collection[str]) -> None:
    """Refuse names of which two are remapped to one: a topic has one type, and all of these have another.

    Raises:
        TopicError: Two are.
    """
    names = [*(name for _, name, _ in _asked_for(transports)), *(name for name, _ in OUTPUTS)]
    by_topic: dict[str, str] = {}
    for name in names:
        topic = node.resolve_topic_name(name)
        if topic in by_topic:
            text = f"{by_topic[topic]} and {name} are both remapped to {topic}, where one type alone can be: "
            raise TopicError(f"{text}give each a topic of its own.")
        by_topic[topic] = name


def _asked_for(transports: Collection[str]) -> Iterator[tuple[Kind, str, Any]]:
    """Kind, name and type of each input that these image transports ask for."""
    for kind, name, message_type, transport in INPUTS:
        if not transport or transport in transports:
            yield kind, name, message_type


class IncompatibleQos:
    """Topics whose other end asks for, or offers, what this node does not."""

    def __init__(self, node: Node) -> None:
        """Begin with none."""
        self._node = node
        self._advice: dict[str, tuple[bool, str]] = {}

    def note(self, topic: str, policy: QoSPolicyKind, *, subscribing: bool) -> None:
        """Warn of one, and keep the advice as long as the other end is there."""
        advice = qos_advice(topic, policy, subscribing=subscribing)
        self._advice[topic] = (subscribing, advice)
        self._node.get_logger().warning(advice)

    def now(self) -> dict[str, str]:
        """The advice for each topic whose other end is still there."""
        for topic, (subscribing, _) in list(self._advice.items()):  # callbacks of other groups change it
            count = self._node.count_publishers if subscribing else self._node.count_subscribers
            if count(topic) == 0:
                self._advice.pop(topic, None)
        return {topic: advice for topic, (_, advice) in list(self._advice.items())}

    def clear(self) -> None:
        """Forget all."""
        self._advice.clear()


class Inputs:
    """The subscriptions of a node. Their reliability follows the publishers where no override names one."""

    def __init__(
        self, node: Node, incompatible: IncompatibleQos, overrides: Collection[str], hears: Callable[[], bool]
    ) -> None:
        """Subscribe to nothing yet.

        Args:
            node: Subscribes.
            incompatible: Is told of publishers that offer too little.
            overrides: Names of the parameters that were given.
            hears: Whether messages are taken at all, so that lost ones are worth telling.
        """
        self.publishers: dict[str, int] = {}
        """By topic, how many there are."""
        self.lost: dict[str, int] = {}
        """By topic, messages that never arrived."""
        self.of_other_types: list[tuple[str, str, str, str, str]] = []
        """What `type_advice` takes, of topics on which another type is published than is read."""
        self._node = node
        self._incompatible = incompatible
        self._overrides = overrides
        self._hears = hears
        self._subscriptions: list[Any] = []
        self._names: dict[str, str] = {}
        """The node's own name for each topic that is subscribed."""
        self._loss_throttle = Throttle(LOSS_REPEAT_AFTER_S)

    @property
    def topics(self) -> list[str]:
        """What is subscribed."""
        return [each.topic_name for each in self._subscriptions]

    def open(self, transports: Collection[str], on_message: Callable[[Kind, str, Any], None]) -> None:
        """Subscribe to all topics of `INPUTS` that these image transports ask for.

        Args:
            transports: "raw", "compressed" or both.
            on_message: Takes a message's kind, its topic and the message.

        Raises:
            RuntimeError: The quality of service that was given is refused.
            ParameterException: Likewise.
        """
        for kind, name, message_type in _asked_for(transports):
            topic = self._node.resolve_topic_name(name)
            callback = functools.partial(on_message, kind, topic)
            subscription = self._subscribe(message_type, name, callback, INPUT_QOS.reliability)
            self._subscriptions.append(subscription)
            self._names[topic] = name

    def close(self) -> None:
        """Subscribe to nothing any more, and forget what was counted."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions, self._names, self.of_other_types = [], {}, []
        self.publishers.clear()
        self.lost.clear()

    def follow_publishers(self) -> None:
        """Ask for reliable delivery where every publisher offers it, and for best effort elsewhere."""
        mistyped = []
        for k, subscription in enumerate(self._subscriptions):
            topic, wanted_type = subscription.topic_name, _type_name(subscription.msg_type)
            publishers = self._node.get_publishers_info_by_topic(topic)
            for carried in sorted({each.topic_type for each in publishers} - {wanted_type}):
                of_that_type = [each for each in self._subscriptions if _type_name(each.msg_type) == carried]
                instead = self._names[of_that_type[0].topic_name] if of_that_type else ""
                mistyped.append((topic, self._names[topic], carried, wanted_type, instead))
            if not self._adapts(topic):
                continue
            offered = {each.qos_profile.reliability for each in publishers}
            best_effort = ReliabilityPolicy.BEST_EFFORT in offered
            wanted = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
            if wanted != subscription.qos_profile.reliability:
                self._subscriptions[k] = self._subscribe_anew(subscription, wanted)
                why = "a publisher is" if best_effort else "every publisher is"
                now = wanted.name.lower().replace("_", " ")
                self._node.get_logger().info(f"{topic} is subscribed {now} from now on, as {why}.")
        self.of_other_types = mistyped

    def _subscribe(
        self, message_type: Any, name: str, callback: Callable[[Any], None], reliability: ReliabilityPolicy
    ) -> Any:
        topic = self._node.resolve_topic_name(name)
        events = SubscriptionEventCallbacks(
            incompatible_qos=functools.partial(self._on_incompatible_qos, topic),
            matched=functools.partial(self._on_matched, topic),
            message_lost=functools.partial(self._on_message_lost, topic),
        )
        self.publishers[topic] = 0
        qos = copy(INPUT_QOS)  # rclpy writes the overrides into the profile
        qos.reliability = reliability
        return self._node.create_subscription(
            message_type,
            name,
            callback,
            qos,
            event_callbacks=events,
            qos_overriding_options=OVERRIDABLE_BUT_RELIABILITY if self._adapts(topic) else OVERRIDABLE,
        )

    def _subscribe_anew(self, old: Any, reliability: ReliabilityPolicy) -> Any:
        """The subscription that takes the place of ``old``, once what has come there is taken."""
        with old.handle:
            take = functools.partial(old.handle.take_message, old.msg_type, old.raw)
            waiting = list(iter(take, None))
        self._node.destroy_subscription(old)
        subscription = self._subscribe(old.msg_type, old.topic, old.callback, reliability)
        for message, _ in waiting:
            old.callback(message)
        return subscription

    def _adapts(self, topic: str) -> bool:
        """Whether the subscription's reliability follows the publishers: an override stays as it is."""
        return f"qos_overrides.{topic}.subscription.reliability" not in self._overrides

    def _on_incompatible_qos(self, topic: str, event: Any) -> None:
        policy = QoSPolicyKind(event.last_policy_kind)
        if policy != QoSPolicyKind.RELIABILITY or not self._adapts(topic):
            self._incompatible.note(topic, policy, subscribing=True)

    def _on_matched(self, topic: str, event: Any) -> None:
        self.publishers[topic] = event.current_count

    def _on_message_lost(self, topic: str, event: Any) -> None:
        # The event's total begins anew with a subscription.
        self.lost[topic] = self.lost.get(topic, 0) + event.total_count_change
        if self._hears():
            line = self._loss_throttle.pass_on(topic, loss_advice(topic, self.lost[topic]))
            if line is not None:
                self._node.get_logger().warning(line)


def _type_name(message_type: Any) -> str:
    """As it is on the graph: sensor_msgs/msg/Image."""
    return f"{message_type.__module__.partition('.')[0]}/msg/{message_type.__name__}"
