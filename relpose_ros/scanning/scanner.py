"""Messages in, estimates out: the one scanner behind the node and the replay. It knows no ROS."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, get_args

from relpose_ros.errors import RelPoseError
from relpose_ros.estimates import Verdict
from relpose_ros.inference.verdict import without_room
from relpose_ros.scanning.incoming import (
    REGION_SCALE,
    SURROUNDINGS_SCALE,
    ViewError,
    object_id_of,
    robot_pose,
    source_of,
    stamp_text,
    view_from_image,
    view_from_object_view,
)
from relpose_ros.scanning.incoming import (
    Kind as Kind,  # a word of this module's interface
)
from relpose_ros.scanning.pairing import Arrival, Pairing
from relpose_ros.scanning.robot_poses import RobotPoses
from relpose_ros.scanning.scan_buffer import ScanBuffer
from relpose_ros.views import MIN_VIEWS, Scan

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from relpose_ros.estimates import ScanEstimate
    from relpose_ros.scanning.incoming import Source
    from relpose_ros.scanning.pairing import ImagePair
    from relpose_ros.scanning.scan_buffer import Decision
    from relpose_ros.scanning.settings import ScanSettings
    from relpose_ros.views import View

_logger = logging.getLogger("relpose_ros")

UNPAIRED_AFTER_S = 2.0
"""An image or a camera info whose counterpart is this late will find none."""


class SupportsEstimate(Protocol):
    """What a scanner asks of an estimator."""

    def estimate(self, scan: Scan) -> ScanEstimate:
        """The poses of a scan of two views or more."""


@dataclass(frozen=True)
class Receipt:
    """What became of a message."""

    accepted: bool
    """Whether its view is held now or waits for a trial, or one is held to which it gives a camera pose."""
    object_id: str
    """Whose view it was; empty where no view came of it (yet)."""
    reason: str
    """A sentence for the log: why not, or what else happened; empty where there is nothing to say."""
    rejected: bool = False
    """Whether the message was bad. A message can be neither accepted nor rejected: it waits for its
    counterpart, came on another topic too, or the scan has views enough."""


@dataclass(frozen=True, eq=False)
class Result:
    """An estimate and the views it was made from.

    An estimate without cameras takes back what was told of an object, of which less than two views are left
    now. ``scan`` then holds the views that it had, for their stamps.
    """

    scan: Scan
    estimate: ScanEstimate


@dataclass(frozen=True)
class TopicStatistics:
    """What came in on one topic."""

    received: int
    used: int
    """Messages of which a view came (an image and its camera info count both), or its camera pose."""
    rejected: int
    last_reason: str
    """Why the last rejected message was rejected; empty where none was."""


@dataclass(frozen=True)
class ScanStatistics:
    """The state of one scan."""

    views: int
    estimates: int
    dropped: int
    """Views declined or let go since the scan began, see ``ScanBuffer.dropped``."""
    latency_s: float | None
    """From receiving the newest view to having its estimate; None before the first estimate."""
    status: str
    """The last estimate's verdict in words; empty before the first."""
    weakest_pair: tuple[int, int] | None
    """Views i and j of the last estimate's least certain pair; None before the first."""
    weakest_probability: float | None
    """Probability that this pair is within 15 degrees of its strongest mode; None before the first."""
    failure: str = ""
    """Why the latest estimate failed, a sentence; empty where it did not."""
    declined: int = 0
    """Views, among those dropped, that the keep policy never gave a place."""


@dataclass(frozen=True)
class Statistics:
    """What a node's diagnostics tell."""

    topics: Mapping[str, TopicStatistics]
    scans: Mapping[str, ScanStatistics]
    """By object id."""
    waiting: int
    """Images that wait for a camera info of their stamp."""
    unpaired_s: float | None
    """Seconds since the first image that found none, if no other image has found one since; else None."""
    images_alone: int
    """Images that found no camera info of their stamp before `ScanSettings.pairing_queue` later ones came."""
    infos_alone: int
    """Camera infos that found no image in time."""
    frames_apart: tuple[str, str] | None
    """The frames of the latest image and camera info of one stamp, where they differ and none met since."""
    images_missing: bool
    """Whether most of the latest camera infos found none."""
    failed: int
    """Estimates that ended in an error."""
    last_failure: str
    """The last such error; empty where there was none."""


class Scanner:
    """Collects the views of each object and estimates every scan that changed.

    ``receive`` may be called from several threads while another one runs ``estimate_pending``. Events worth
    a line in the log go to the standard logger ``relpose_ros``; what was wrong with a message is in its
    receipt.
    """

    def __init__(
        self, estimator: SupportsEstimate, settings: ScanSettings, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Make a scanner that holds nothing yet.

        Args:
            estimator: Makes the estimates.
            settings: Which views to hold, and how long.
            clock: Seconds, for latencies and for how long messages wait.
        """
        self._estimator = estimator
        self._settings = settings
        self._clock = clock
        # Order of acquisition: _estimating or _receiving, then _state. Views enter a scan in the order of
        # their messages although decoding takes a while, and the state stays free meanwhile.
        self._estimating = threading.Lock()
        self._receiving = threading.Lock()
        self._state = threading.Lock()
        self._pairing = Pairing(settings.pairing_queue, round(settings.backward_jump_s * 1e9))
        self._robot_poses = RobotPoses()
        self._scans: dict[str, _ScanState] = {}
        self._topics: dict[str, _TopicState] = {}
        self._taken_back: list[Result] = []
        self._unpaired_since: float | None = None
        self._infos = _InfoRecord()
        self._failed = self._turns = 0
        self._last_failure = ""
        self._last_error = ""

    def receive(self, kind: Kind, topic: str, message: Any, camera: str = "") -> Receipt:
        """Take one message in. Never raises for a bad message: the receipt says what was wrong.

        Args:
            kind: What the message is.
            topic: Where it came from, as the user knows it.
            message: Any object with the fields of its kind (rclpy's or rosbags', or another's).
            camera: Whose image or camera info it is, where there are several cameras: only messages
                of one camera are paired.
        """
        if kind not in get_args(Kind):
            raise ValueError(f"There is no message kind {kind!r}.")
        with self._receiving:
            with self._state:
                self._topics.setdefault(topic, _TopicState()).received += 1
            try:
                if kind == "object_view":
                    return self._receive_object_view(topic, message)
                if kind == "camera_pose":
                    return self._receive_camera_pose(topic, message)
                return self._receive_half(kind, topic, message, camera)
            except ViewError as err:
                return self._rejected(topic, "", str(err))
            except Exception as err:
                # The message types rule this out, an object with the same fields does not; and a callback
                # that raises would end the node.
                _logger.debug("A message on %s could not be read.", topic, exc_info=True)
                text = f"{topic}: the message cannot be read as {kind}: {type(err).__name__}: {err}."
                return self._rejected(topic, "", text)

    def pending(self) -> bool:
        """Whether ``estimate_pending`` has work to do."""
        with self._state:
            work = any(state.buffer.has_work() for state in self._scans.values())
            return work or bool(self._taken_back)

    def estimate_pending(self) -> list[Result]:
        """Estimate a scan that changed since its last estimate and has two views or more.

        Of several the one whose turn is longest ago. What has to be taken back of others is among the
        results, in the order in which it happened.

        All views that came meanwhile are taken together. Call it again while ``pending()``. A result whose
        scan was reset while it was made is dropped; so is a trial of a further view (keep policy "spread")
        that the scan does not take.
        """
        with self._estimating:
            with self._state:
                changed = [state for state in self._scans.values() if state.buffer.has_work()]
                changed.sort(key=lambda state: state.turn)
            return self._estimate(changed[:1])

    def estimate_now(self, object_id: str | None = None) -> list[Result]:
        """Estimate a scan, or all, changed or not. No result has cameras where none has two views."""
        with self._estimating:
            with self._state:
                chosen = [self._scans[each] for each in self._scans if object_id in {None, each}]
                for state in chosen:
                    state.buffer.require_work()
            return self._estimate(chosen)

    def stands(self, result: Result) -> bool:
        """Whether a result holds still, and no view of its scan was forgotten since."""
        with self._state:
            state = self._scans.get(result.scan.object_id)
            if state is None or state.estimate is not result.estimate:
                return False
            return state.epoch == state.buffer.epoch

    def objects(self) -> list[str]:
        """The objects of which views are held, the one seen last at the end."""
        with self._state:
            return list(self._scans)

    def require_estimates(self) -> None:
        """Have every scan estimated, changed or not."""
        with self._state:
            for state in self._scans.values():
                state.buffer.require_work()

    def reset(self, reason: str, object_id: str | None = None) -> int:
        """Forget the views of one object, or of all, and what waits for its counterpart.

        Args:
            reason: Why, for the log.
            object_id: Whose views; None for all.

        Returns:
            How many views were forgotten.
        """
        with self._receiving, self._state:
            self._pairing.clear()
            self._infos.clear()
            self._unpaired_since = None
            chosen = [each for each in self._scans if object_id in {None, each}]
            forgotten = 0
            for each in chosen:
                state = self._scans.pop(each)
                views = len(state.buffer.views)
                forgotten += views
                self._take_back(state, state.buffer.views, f"no view is left: {reason}")
                _logger.info("The scan of %r with %d views is forgotten: %s.", each, views, reason)
            self._robot_poses.forget(self._stamps_held())
            return forgotten

    def drop_last_view(self, object_id: str | None = None) -> Receipt:
        """Forget the newest view of an object, or of the object that was seen last.

        ``accepted`` tells whether there was one, ``reason`` what was dropped.
        """
        with self._receiving, self._state:
            # The object seen last stands last.
            chosen = [each for each in reversed(self._scans) if object_id in {None, each}]
            for each in chosen:
                state = self._scans[each]
                view = state.buffer.drop_last()
                if view is not None:
                    left = state.buffer.views
                    if len(left) < MIN_VIEWS:
                        self._take_back(state, (*left, view), "one more view: only one is left")
                    text = f"The view of {each!r} with stamp {stamp_text(view.stamp_ns)} is dropped."
                    return Receipt(True, each, text)
        of = "" if object_id is None else f" of {object_id!r}"
        return Receipt(False, object_id or "", f"There is no view{of} to drop.")

    def change_settings(self, settings: ScanSettings) -> None:
        """Go on with other settings, from the next message on. Views that are too many now leave at once.

        Where other evidence counts, of which the caller tells the estimator, every scan is estimated again.
        """
        with self._receiving, self._state:
            evidence_changed = settings.evidence_settings != self._settings.evidence_settings
            self._settings = settings
            self._pairing.limit = settings.pairing_queue
            self._pairing.backward_jump_ns = round(settings.backward_jump_s * 1e9)
            for state in self._scans.values():
                state.buffer.change_settings(settings)
                if evidence_changed:
                    state.buffer.require_work()
            while len(self._scans) > settings.max_scans:
                self._forget_oldest_scan()

    def statistics(self) -> Statistics:
        """A snapshot for diagnostics."""
        with self._receiving:
            waiting, images_alone = self._pairing.waiting(), self._pairing.images_alone
            frames_apart = self._pairing.frames_apart
            since = self._unpaired_since
            self._infos.settle(self._clock())
            infos_alone, images_missing = self._infos.alone, self._infos.most_are_alone()
        with self._state:
            return Statistics(
                topics={
                    topic: TopicStatistics(each.received, each.used, each.rejected, each.last_reason)
                    for topic, each in self._topics.items()
                },
                scans={object_id: state.snapshot() for object_id, state in self._scans.items()},
                waiting=waiting,
                images_alone=images_alone,
                frames_apart=frames_apart,
                unpaired_s=None if since is None else self._clock() - since,
                infos_alone=infos_alone,
                images_missing=images_missing,
                failed=self._failed,
                last_failure=self._last_failure,
            )

    def _receive_object_view(self, topic: str, message: Any) -> Receipt:
        source = source_of(message, topic)
        object_id, scale = object_id_of(message, source, self._settings.object_id), self._region_scale
        return self._offer(object_id, source, lambda: view_from_object_view(message, source, scale), (topic,))

    def _receive_camera_pose(self, topic: str, message: Any) -> Receipt:
        source = source_of(message, topic)
        settings = self._settings
        deviations = settings.camera_pose_position_deviation, settings.camera_pose_rotation_deviation
        pose = robot_pose(message, source, deviations)
        with self._state:
            news, gone = self._robot_poses.put(source, pose, self._stamps_held())
            for unknown in gone:
                text = "no view has this stamp: a camera's pose takes the stamp of the image"
                self._count_rejected(unknown.topic, str(unknown.rejection(text)))
            states = [state for state in self._scans.values() if source.stamp_ns in state.buffer.stamps()]
            if not news or not states:
                return Receipt(False, "", "")
            self._claim_robot_pose(source.stamp_ns)
            for state in states:
                state.buffer.require_work()
            return Receipt(True, states[-1].buffer.object_id, "")

    def _claim_robot_pose(self, stamp_ns: int) -> None:
        source = self._robot_poses.claim(stamp_ns)
        if source is not None:
            self._topics[source.topic].used += 1

    @property
    def _region_scale(self) -> float:
        return SURROUNDINGS_SCALE if self._settings.surroundings else REGION_SCALE

    def _stamps_held(self) -> set[int]:
        return set().union(*(state.buffer.stamps() for state in self._scans.values()))

    def _receive_half(self, kind: Kind, topic: str, message: Any, camera: str) -> Receipt:
        source = source_of(message, topic)
        pairs = self._pairing.add(kind, Arrival(message, source), camera)
        if kind == "camera_info":
            self._infos.came(camera, source, self._clock())
        for pair in pairs:
            self._infos.found_image(camera, pair.info.source)
        receipts = [self._offer_pair(pair) for pair in pairs]
        if not receipts:
            if kind != "camera_info" and self._unpaired_since is None:
                self._unpaired_since = self._clock()
            return Receipt(False, "", "")
        self._unpaired_since = None
        # Of a picture that came both raw and compressed, one is enough.
        return max(receipts, key=lambda receipt: (receipt.accepted, receipt.rejected))

    def _offer_pair(self, pair: ImagePair) -> Receipt:
        image, info = pair.image, pair.info
        topics, rectification = (image.source.topic, info.source.topic), self._settings.rectification
        scale = self._region_scale
        try:
            return self._offer(
                self._settings.object_id,
                image.source,
                lambda: view_from_image(image.message, info.message, image.source, rectification, scale),
                topics,
            )
        except ViewError as err:
            return self._rejected(image.source.topic, self._settings.object_id, str(err))

    def _offer(
        self, object_id: str, source: Source, decode: Callable[[], View], topics: tuple[str, ...]
    ) -> Receipt:
        """Give a view to its scan; it is decoded only if the scan may want it."""
        with self._state:
            known = self._scans.get(object_id)
            decision = (
                None
                if known is None
                else known.buffer.declines(source.stamp_ns, source.frame_id, source.topic)
            )
            if decision is not None:
                self._note_seen(object_id, decision)
        if decision is None:
            view = decode()
            with self._state:
                state = self._scans.get(object_id) or self._begin_scan(object_id)
                decision = state.buffer.add(view, source.topic)
                self._note_seen(object_id, decision)
                if decision.accepted:
                    state.arrived = self._clock()
                    for topic in topics:
                        self._topics[topic].used += 1
                    self._claim_robot_pose(view.stamp_ns)
                    text = str(source.rejection(decision.reason)) if decision.reason else ""
                    return Receipt(True, object_id, text)
        text = str(source.rejection(decision.reason))
        if decision.rejected:
            return self._rejected(source.topic, object_id, text)
        with self._state:
            self._robot_poses.pass_over(source.stamp_ns)
        return Receipt(False, object_id, text)

    def _note_seen(self, object_id: str, decision: Decision) -> None:
        """The object seen last stands last, also where its scan needs no more views."""
        if not decision.rejected:
            self._scans[object_id] = self._scans.pop(object_id)

    def _begin_scan(self, object_id: str) -> _ScanState:
        if len(self._scans) >= self._settings.max_scans:
            self._forget_oldest_scan()
        self._scans[object_id] = _ScanState(ScanBuffer(object_id, self._settings))
        return self._scans[object_id]

    def _forget_oldest_scan(self) -> None:
        oldest = next(iter(self._scans))
        state = self._scans.pop(oldest)
        views = len(state.buffer.views)
        self._take_back(state, state.buffer.views, "no view is left: another object needed the room")
        text = "The scan of %r with %d views is forgotten to make room: max_scans is %d."
        _logger.warning(text, oldest, views, self._settings.max_scans)

    def _take_back(self, state: _ScanState, views: tuple[View, ...], status: str) -> None:
        """Have it told that the last estimate of a scan holds no longer, if there is one."""
        if state.estimate is not None:
            nothing = replace(
                state.estimate,
                cameras=(),
                pairs=(),
                score=0.0,
                scale_known=False,
                scale_deviation=0.0,
                object_pose=None,
                verdict=Verdict.ONE_MORE_VIEW,
                weakest_pair=0,
                status=status,
                seconds=0.0,
            )
            self._taken_back.append(Result(Scan(state.buffer.object_id, views), nothing))
            state.estimate = state.latency_s = None

    def _rejected(self, topic: str, object_id: str, reason: str) -> Receipt:
        with self._state:
            self._count_rejected(topic, reason)
        return Receipt(False, object_id, reason, rejected=True)

    def _count_rejected(self, topic: str, reason: str) -> None:
        self._topics[topic].rejected += 1
        self._topics[topic].last_reason = reason

    def _estimate(self, states: list[_ScanState]) -> list[Result]:
        """One estimate of each scan; the state is free while the estimator runs."""
        results: list[Result] = []
        for state in states:
            with self._state:
                if self._scans.get(state.buffer.object_id) is not state:  # reset meanwhile
                    continue
                work, arrived = state.buffer.work(), state.arrived
                if work is None:
                    continue
                self._turns += 1
                state.turn = self._turns
                poses = self._robot_poses.of(work.views)
            scan = Scan(state.buffer.object_id, work.views, poses)
            try:
                estimate = self._estimator.estimate(scan)
                if len(scan.views) >= self._settings.max_views:
                    words = without_room(estimate.status, self._settings.keep)
                    estimate = replace(estimate, status=words)
            except Exception as err:
                what = f"The estimate of {scan.object_id!r} from {len(scan.views)} views"
                text = f"{what} failed: {str(err).rstrip('.')}."
                with self._state:
                    state.buffer.give_up(work)
                    if work.without is not None:  # a trial, of a failure that was told
                        continue
                    self._failed += 1
                    self._last_failure = text
                    if work.epoch == state.buffer.epoch:
                        state.failure = text
                    # A sentence for the user needs no traceback, a defect does, once.
                    trace = not isinstance(err, RelPoseError) and repr(err) != self._last_error
                    self._last_error = repr(err)
                _logger.error("%s The views are kept.", text, exc_info=trace)
                continue
            with self._state:
                self._move_taken_back(results)
                current = self._scans.get(scan.object_id) is state
                if current and state.buffer.settle(work, estimate):
                    state.estimates, state.failure = state.estimates + 1, ""
                    state.epoch = state.buffer.epoch
                    state.latency_s = self._clock() - arrived
                    state.estimate = estimate
                    results.append(Result(scan, estimate))
        with self._state:
            self._move_taken_back(results)
        return results

    def _move_taken_back(self, results: list[Result]) -> None:
        results += self._taken_back
        self._taken_back.clear()


class _InfoRecord:
    """Which camera infos find an image, and which have waited too long for one."""

    def __init__(self) -> None:
        self.alone = 0
        self._waiting: dict[tuple[str, int, str], float] = {}
        """When each came, by its camera, stamp and frame."""
        self._found: set[tuple[str, int, str]] = set()
        self._latest: deque[bool] = deque(maxlen=10)

    def came(self, camera: str, source: Source, now: float) -> None:
        self.settle(now)
        self._waiting.setdefault((camera, source.stamp_ns, source.frame_id), now)

    def found_image(self, camera: str, source: Source) -> None:
        key = camera, source.stamp_ns, source.frame_id
        if key in self._waiting:
            self._found.add(key)

    def settle(self, now: float) -> None:
        """Judge those that came long ago, in their order: how many images get lost is what counts."""
        while self._waiting:
            oldest = next(iter(self._waiting))
            if now - self._waiting[oldest] <= UNPAIRED_AFTER_S:
                return
            del self._waiting[oldest]
            self._latest.append(oldest in self._found)
            self.alone += oldest not in self._found
            self._found.discard(oldest)

    def most_are_alone(self) -> bool:
        """Whether most of the latest found no image. Two say nothing: a camera may just have begun."""
        return len(self._latest) > 2 and 2 * sum(self._latest) < len(self._latest)

    def clear(self) -> None:
        """Forget all but the count."""
        self._waiting.clear()
        self._found.clear()
        self._latest.clear()


@dataclass
class _TopicState:
    received: int = 0
    used: int = 0
    rejected: int = 0
    last_reason: str = ""


@dataclass
class _ScanState:
    buffer: ScanBuffer
    arrived: float = 0.0
    """When the newest view came, by the scanner's clock."""
    estimates: int = 0
    latency_s: float | None = None
    estimate: ScanEstimate | None = None
    epoch: int = 0
    """The buffer's, when that estimate was made."""
    failure: str = ""
    turn: int = 0
    """Counts the scanner's estimates, when this scan was estimated last."""

    def snapshot(self) -> ScanStatistics:
        pairs = () if self.estimate is None else self.estimate.pairs
        weakest = pairs[self.estimate.weakest_pair] if self.estimate is not None and pairs else None
        return ScanStatistics(
            views=len(self.buffer.views),
            estimates=self.estimates,
            dropped=self.buffer.dropped,
            latency_s=self.latency_s,
            status="" if self.estimate is None else self.estimate.status,
            weakest_pair=None if weakest is None else (weakest.i, weakest.j),
            weakest_probability=None if weakest is None else weakest.probability_within_15_deg,
            failure=self.failure if len(self.buffer.views) >= MIN_VIEWS else "",
            declined=self.buffer.declined,
        )
