"""The views held of one object: which are taken, which stay, and what is to be estimated next."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakSet

import numpy as np

from relpose_ros.estimates import Verdict
from relpose_ros.scanning.incoming import stamp_text
from relpose_ros.scanning.stamp_order import StampOrder
from relpose_ros.views import MIN_VIEWS

if TYPE_CHECKING:
    from relpose_ros.estimates import FloatArray, ScanEstimate
    from relpose_ros.scanning.settings import ScanSettings
    from relpose_ros.views import View

SPREAD_MARGIN = np.radians(1.0)
"""How much further from all others than the most redundant view a newcomer must look, so that the noise of
two estimates does not swap views of a camera that stands still."""

SHORTEST_PAUSE_NS, LONGEST_PAUSE_NS = 200_000_000, 1_000_000_000
"""After a newcomer that gained nothing, how long the next ones are not tried (keep policy "spread"). The
pause doubles each time: a camera that stands still must not keep the estimator busy for ever, and one that
moves on is soon tried again. By stamps, so that a replay does the same."""

_logger = logging.getLogger("relpose_ros")


@dataclass(frozen=True)
class Decision:
    """What became of a view."""

    accepted: bool
    reason: str = ""
    """Why not, as the end of a sentence; empty where there is nothing to say."""
    rejected: bool = False
    """Whether something was wrong with it; neither accepted nor rejected is a view nobody needs."""


@dataclass(frozen=True, eq=False)
class Work:
    """Views to estimate, oldest first."""

    views: tuple[View, ...]
    newcomer: View | None
    """The view whose place in the scan depends on the estimate (keep policy "spread"), or None."""
    without: View | None
    """A view held that is left out to see whether estimates fail of it, or None."""
    epoch: int
    """The buffer's count of forgetting, when the work was given out."""


class ScanBuffer:
    """The views of one object.

    A view that was taken leaves only by the keep policy, by a confirmed backward jump of time, because
    estimates fail with it and not without it, or because someone asked for it: nothing that arrives can
    damage what is held. Not thread-safe by itself.
    """

    def __init__(self, object_id: str, settings: ScanSettings) -> None:
        """Make one without views."""
        self.object_id = object_id
        self.dropped = 0
        """Views declined or let go: by the keep policy, after a jump of time, as the cause of failing
        estimates, or because someone asked."""
        self.declined = 0
        """Those among them that never had a place."""
        self._settings = settings
        self._views: list[View] = []
        self._candidates: deque[View] = deque()
        self._on_trial: View | None = None
        self._pause_ns = self._paused_until_ns = 0
        self._order = StampOrder(self._all, round(settings.backward_jump_s * 1e9))
        self._changed = False
        self._failed = False
        """Whether the latest estimate failed, and no view came since."""
        self._doubted: deque[View] = deque()
        """Views that estimates may fail of, which are to be left out in turn."""
        self._failed_before = False
        """Whether estimates failed since the last one that did not."""
        self._estimated: WeakSet[View] = WeakSet()
        """Views of the last estimate that did not fail, as far as they are still held."""
        self._base: ScanEstimate | None = None
        """Of exactly the views held, where there is one."""
        self._epoch = 0

    @property
    def epoch(self) -> int:
        """Counts how often views that were taken had to go for another reason than the keep policy."""
        return self._epoch

    @property
    def views(self) -> tuple[View, ...]:
        """The views held, oldest first, without those whose place is not decided yet."""
        return tuple(self._views)

    def stamps(self) -> set[int]:
        """Of the views held and of those whose place is not decided yet, ns."""
        return {view.stamp_ns for view in self._all()}

    def declines(self, stamp_ns: int, frame_id: str, topic: str) -> Decision | None:
        """The answer to a view that would not be taken whatever it shows; None: show it.

        Saves decoding it.
        """
        if not self._all() or self._order.jumps_back(stamp_ns, frame_id, topic):
            return None
        if self._order.confirms_jump(stamp_ns, frame_id, topic):
            return None
        if self._order.repeats(stamp_ns, frame_id, topic):
            text = f"a view with this stamp and frame_id {frame_id!r} came on this topic before"
            advice = "give each picture its own stamp, and each camera its own frame_id"
            return Decision(False, f"{text}: {advice}", rejected=True)
        if self._order.was_seen(stamp_ns, frame_id):
            return Decision(False, "a view with this stamp and frame was seen already")
        own_ns = self._order.newest_of(topic, frame_id)
        if own_ns is not None and stamp_ns < own_ns:
            late = (
                f"it is {(own_ns - stamp_ns) / 1e9:.3f} s older than the newest view of {self.object_id!r} on"
            )
            order = "views of a camera have to come in the order of their stamps"
            return Decision(False, f"{late} this topic with frame_id {frame_id!r}: {order}", rejected=True)
        if self._views and stamp_ns < self._views[0].stamp_ns:
            late = f"it is {(self._views[0].stamp_ns - stamp_ns) / 1e9:.3f} s older than the first view"
            text = f"{late} of {self.object_id!r}, in whose axes the poses are told"
            return Decision(False, f"{text}: the cameras' pictures have to come sooner", rejected=True)
        full = len(self._views) >= self._settings.max_views
        if full and (self._settings.keep == "first" or self._is_paused(stamp_ns)):
            self._note_arrival(stamp_ns, frame_id, topic)
            return self._decline_further(stamp_ns)
        return None

    def add(self, view: View, topic: str) -> Decision:
        """Take a view, or say why not.

        Views of one stamp are two where their frames differ: of cameras that are triggered together. What a
        stamp far behind says, `StampOrder` tells.
        """
        declined = self.declines(view.stamp_ns, view.frame_id, topic)
        if declined is not None:
            return declined
        if self._order.confirms_jump(view.stamp_ns, view.frame_id, topic):
            first = self._order.suspected(topic)
            together = self._order.suspects_at(first.stamp_ns)
            self._follow_jump(first)
            for each, origin in together:
                if not self._order.was_seen(each.stamp_ns, each.frame_id):
                    self._take(each, origin)
        elif self._order.jumps_back(view.stamp_ns, view.frame_id, topic):
            self._order.suspect(view, topic)
            than, newest_ns = "the last one on this topic", self._order.newest_on(topic) or 0
            if newest_ns <= view.stamp_ns:
                than, newest_ns = "the newest view", max(each.stamp_ns for each in self._all())
            behind = (newest_ns - view.stamp_ns) / 1e9
            text = f"it is {behind:.3f} s older than {than}: rejected unless the next one confirms"
            return Decision(False, f"{text} that time jumped backwards", rejected=True)
        return self._take(view, topic)

    def work(self) -> Work | None:
        """What to estimate next, which counts as begun; None where there is nothing to do."""
        if self._changed and len(self._views) >= MIN_VIEWS:
            self._changed = False
            return Work(self.views, None, None, self._epoch)
        if self._doubted:
            doubted = self._doubted.popleft()
            others = tuple(view for view in self._views if view is not doubted)
            return Work(others, None, doubted, self._epoch)
        if self._candidates and self._base is not None:
            self._on_trial = self._candidates.popleft()
            redundant = most_redundant(viewing_directions(self._base))
            kept = [view for index, view in enumerate(self._views) if index != redundant]
            return Work((*kept, self._on_trial), self._on_trial, None, self._epoch)
        return None

    def has_work(self) -> bool:
        """Whether `work` has something to give."""
        if self._doubted or (self._changed and len(self._views) >= MIN_VIEWS):
            return True
        return bool(self._candidates) and self._base is not None

    def require_work(self) -> None:
        """Have the views estimated even if they did not change."""
        self._changed = True

    def settle(self, work: Work, estimate: ScanEstimate) -> bool:
        """Take note of an estimate.

        Returns:
            Whether it is one of this scan: not of views that were forgotten meanwhile, nor with a newcomer
            that the scan does not take. It takes one whose nearest neighbour in direction is further away, by
            more than ``SPREAD_MARGIN``, than the two closest of the views held are from one another; unless
            the views held are enough and would be no more.
        """
        if work.epoch != self._epoch:
            return False
        self._estimated = WeakSet(work.views)
        self._failed_before = False
        self._doubted.clear()
        if work.without is not None:
            text = "The view of %r with stamp %s is let go: estimates fail with it, and not without it."
            _logger.warning(text, self.object_id, stamp_text(work.without.stamp_ns))
            self._forget([work.without])
            self._changed = work.views != self.views
        if work.newcomer is None:
            self._base = estimate if work.views == self.views else None
            return True
        assert self._base is not None
        self._on_trial = None
        before = nearest_angles(viewing_directions(self._base)).min()
        after = nearest_angles(viewing_directions(estimate))[-1]
        undoes = self._base.verdict is Verdict.ENOUGH and estimate.verdict is not Verdict.ENOUGH
        if undoes or not after > before + SPREAD_MARGIN:
            self._decline()
            self._pause(work.newcomer.stamp_ns)
            return False
        self.dropped += 1
        self._views, self._base = list(work.views), estimate
        self._pause_ns = self._paused_until_ns = 0
        return True

    def give_up(self, work: Work) -> None:
        """Take note that an estimate failed: the views stay, and the next view has it tried again.

        Where that fails too, estimates without one or the other of the views that came since the last one
        that did not fail tell which of them it fails of, if it is one.
        """
        if work.epoch != self._epoch or work.without is not None:
            return
        if work.newcomer is not None:
            self._on_trial = None
            self._decline()
        elif self._failed_before and len(self._views) > MIN_VIEWS:
            self._doubted = deque(view for view in self._views if view not in self._estimated)
        self._failed = self._failed_before = True

    def drop_last(self) -> View | None:
        """Forget the newest view held and give it back; None where there is none.

        Views whose place is not decided yet go too: one of them would take the room at once.
        """
        if not self._views:
            return None
        last = self._views[-1]
        self._forget(self._all()[len(self._views) - 1 :])
        return last

    def change_settings(self, settings: ScanSettings) -> None:
        """Go on with other settings; views that are too many now leave by the new keep policy."""
        self._settings = settings
        self._order.backward_jump_ns = round(settings.backward_jump_s * 1e9)
        views, most = self._all(), settings.max_views
        surplus = {"first": views[most:], "latest": views[:-most], "spread": []}[settings.keep]
        if surplus or len(self._views) != min(len(views), most):
            self._forget(surplus)

    def _take(self, view: View, topic: str) -> Decision:
        """Take a view that no other of its camera is newer than."""
        self._note_arrival(view.stamp_ns, view.frame_id, topic)
        full = len(self._views) >= self._settings.max_views
        if full and self._settings.keep == "first":
            return self._decline_further(view.stamp_ns)
        if full and self._settings.keep == "spread":
            self._candidates.append(view)
            if len(self._candidates) > self._settings.max_views:
                self._candidates.popleft()
                self._decline()
            return Decision(True, "the scan is full: the next estimate tells whether it is worth a place")
        if full:
            del self._views[0]
            self.dropped += 1
        later = sum(each.stamp_ns > view.stamp_ns for each in self._views)
        self._views.insert(len(self._views) - later, view)
        self._changed, self._base = True, None
        return Decision(True)

    def _decline_further(self, stamp_ns: int) -> Decision:
        self._decline()
        text = f"the scan of {self.object_id!r} has its {len(self._views)} views"
        if self._is_paused(stamp_ns):
            text += ", and one seen just before it gained nothing"
        return Decision(False, text)

    def _decline(self) -> None:
        self.dropped += 1
        self.declined += 1

    def _note_arrival(self, stamp_ns: int, frame_id: str, topic: str) -> None:
        self._order.note(stamp_ns, frame_id, topic)
        # What is held, or a newcomer on trial, would wait for ever for an estimate that failed.
        self._changed |= self._failed
        self._failed = False

    def _pause(self, stamp_ns: int) -> None:
        """Try no newcomer for a while after one that gained nothing."""
        self._pause_ns = min(max(2 * self._pause_ns, SHORTEST_PAUSE_NS), LONGEST_PAUSE_NS)
        self._paused_until_ns = stamp_ns + self._pause_ns
        while self._candidates and self._is_paused(self._candidates[0].stamp_ns):
            self._candidates.popleft()
            self._decline()

    def _is_paused(self, stamp_ns: int) -> bool:
        return self._settings.keep == "spread" and stamp_ns < self._paused_until_ns

    def _follow_jump(self, first: View) -> None:
        """Forget what lies after the first view of the time that counts from now on."""
        views = self._all()
        ahead = [view for view in views if view.stamp_ns > first.stamp_ns]
        repeated = self._order.was_seen(first.stamp_ns, first.frame_id)
        lone = len({view.stamp_ns for view in ahead}) == 1 and len(views) > len(ahead)
        if lone and not repeated:
            text = "What was seen of %r with stamp %s is dropped: two later messages are older than that."
            _logger.warning(text, self.object_id, stamp_text(ahead[0].stamp_ns))
            self._forget(ahead)
        elif ahead or repeated:
            text = "Time jumped backwards from %s to %s: the scan of %r starts anew."
            newest, stamp = stamp_text(views[-1].stamp_ns), stamp_text(first.stamp_ns)
            _logger.warning(text, newest, stamp, self.object_id)
            self._forget(views)
        self._order.restart(seen_too=True)

    def _forget(self, views: list[View]) -> None:
        self.dropped += len(views)
        self._epoch += 1
        left = [view for view in self._all() if view not in views]
        self._on_trial = None
        self._doubted.clear()
        self._pause_ns = self._paused_until_ns = 0
        self._views = left[: self._settings.max_views]
        self._candidates = deque(left[self._settings.max_views :])
        self._changed, self._base = True, None
        if not left:
            self._order.restart(seen_too=False)

    def _all(self) -> list[View]:
        """The views held and those whose place is not decided yet, oldest first."""
        undecided = [] if self._on_trial is None else [self._on_trial]
        return [*self._views, *undecided, *self._candidates]


def viewing_directions(estimate: ScanEstimate) -> FloatArray:
    """From the cameras to the object, unit vectors in its frame, (N, 3). A camera that pans keeps its own."""
    positions = np.stack([camera.position for camera in estimate.cameras])
    return np.asarray(-positions / np.maximum(np.linalg.norm(positions, axis=1, keepdims=True), 1e-9))


def nearest_angles(directions: FloatArray) -> FloatArray:
    """The angle from each of two directions or more to the nearest other one, rad. (N, 3) -> (N,)."""
    return np.asarray(_angles(directions).min(axis=1))


def most_redundant(directions: FloatArray) -> int:
    """Which view tells least that the others do not. (N, 3) -> index.

    It is one of the two that look from the closest directions, namely the one with the closer second
    neighbour; but never the first view, which sets the object frame.
    """
    closest = np.sort(_angles(directions), axis=1)[1:, :2]
    return 1 + int(np.lexsort((closest[:, 1], closest[:, 0]))[0])


def _angles(directions: FloatArray) -> FloatArray:
    """Angles between all directions, (N, N); infinite between one and itself."""
    angles: FloatArray = np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))
    np.fill_diagonal(angles, np.inf)
    return angles
