"""The order of stamps, on each topic and of each camera, and clocks that jump backwards."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from relpose_ros.views import View

LONGEST_LAG_NS = 60 * 10**9
"""No camera delivers later than this behind another one: what is further ahead of a view, and alone, may be a
garbage stamp."""

_SEEN = 64
"""Pictures remembered to tell one that comes raw and compressed: no transport lags by more."""


class StampOrder:
    """What stamps have come of one object.

    A stamp far behind the last one on its topic is a garbage stamp or a clock that jumped backwards, unless
    it is ahead of the last one of its own camera, which is slow. The next message on the topic tells which:
    if it is behind as well and in order, time did jump; or if both repeat what was seen before, as in a bag
    too short for two messages far behind. Of a camera that is new on a topic of others, only messages further
    apart than a jump tell: it may have begun with a few that were late.
    """

    def __init__(self, held: Callable[[], list[View]], backward_jump_ns: int) -> None:
        """Begin without any.

        Args:
            held: Gives the views held and those whose place is not decided yet, oldest first.
            backward_jump_ns: How far back a stamp must lie to count as a jump, and not as late.
        """
        self.backward_jump_ns = backward_jump_ns
        self._held = held
        self._newest_on: dict[str, int] = {}
        self._newest_of: dict[tuple[str, str], int] = {}
        """Of each camera: the same by topic and frame."""
        self._suspects: dict[str, list[View]] = {}
        """Views of one stamp on each topic, from cameras that are triggered together."""
        self._seen: deque[tuple[int, str, str]] = deque(maxlen=_SEEN)
        """Stamp and frame, which are what tells pictures apart whatever their topic, and that topic."""

    def note(self, stamp_ns: int, frame_id: str, topic: str) -> None:
        """Time goes on in this topic: whatever lay far behind was garbage."""
        self._seen.append((stamp_ns, frame_id, topic))
        # A camera that delivers later does not turn the topic's clock back.
        self._newest_on[topic] = max(stamp_ns, self._newest_on.get(topic, stamp_ns))
        self._newest_of.pop((topic, frame_id), None)
        self._newest_of[topic, frame_id] = stamp_ns
        if len(self._newest_of) > _SEEN:  # a name of its own for each picture
            del self._newest_of[next(iter(self._newest_of))]
        self._suspects.pop(topic, None)

    def newest_on(self, topic: str) -> int | None:
        """The newest stamp on a topic, ns."""
        return self._newest_on.get(topic)

    def newest_of(self, topic: str, frame_id: str) -> int | None:
        """The newest stamp of a camera on a topic, ns."""
        return self._newest_of.get((topic, frame_id))

    def repeats(self, stamp_ns: int, frame_id: str, topic: str) -> bool:
        """Whether a view of that stamp and frame came on that topic before."""
        return (stamp_ns, frame_id, topic) in self._seen

    def was_seen(self, stamp_ns: int, frame_id: str) -> bool:
        """Whether a view of that stamp and frame came on any topic, or is held."""
        picture = stamp_ns, frame_id
        seen = any(each[:2] == picture for each in self._seen)
        return seen or any((view.stamp_ns, view.frame_id) == picture for view in self._held())

    def jumps_back(self, stamp_ns: int, frame_id: str, topic: str) -> bool:
        """Whether a stamp lies so far back that it is garbage, or time jumped."""
        ahead = {view.stamp_ns for view in self._held() if view.stamp_ns > stamp_ns + LONGEST_LAG_NS}
        if len(ahead) == 1:
            return True
        # Each topic's own clock, and each camera's: another one may lag behind by more than any jump.
        newest_ns, own_ns = self.newest_on(topic), self.newest_of(topic, frame_id)
        lags = own_ns is not None and own_ns < stamp_ns
        return newest_ns is not None and not lags and stamp_ns <= newest_ns - self.backward_jump_ns

    def suspect(self, view: View, topic: str) -> None:
        """Remember a view that may be the first after a jump, with those of its stamp."""
        suspects = self._suspects.get(topic, [])
        together = [each for each in suspects if each.stamp_ns == view.stamp_ns]
        if suspects and not together and view.stamp_ns > suspects[0].stamp_ns:
            return  # it is in order, but did not confirm the first yet
        others = [each for each in together if each.frame_id != view.frame_id]
        self._suspects[topic] = [*others, view]

    def confirms_jump(self, stamp_ns: int, frame_id: str, topic: str) -> bool:
        """Whether a stamp shows that time did jump back before the topic's suspected view."""
        suspects = self._suspects.get(topic)
        if not suspects or stamp_ns <= suspects[0].stamp_ns:
            return False
        first = suspects[0]
        if self.was_seen(first.stamp_ns, first.frame_id) and self.was_seen(stamp_ns, frame_id):
            return True
        if not self.jumps_back(stamp_ns, frame_id, topic):
            return False
        is_new = topic in self._newest_on and (topic, frame_id) not in self._newest_of
        return not is_new or stamp_ns >= first.stamp_ns + self.backward_jump_ns

    def suspected(self, topic: str) -> View:
        """The topic's first view after a jump that is confirmed."""
        return self._suspects[topic][0]

    def suspects_at(self, stamp_ns: int) -> list[tuple[View, str]]:
        """The suspected views of a stamp, with their topics."""
        return [
            (each, origin)
            for origin, views in self._suspects.items()
            for each in views
            if each.stamp_ns == stamp_ns
        ]

    def restart(self, *, seen_too: bool) -> None:
        """Begin anew with what comes next.

        Args:
            seen_too: Whether pictures that were seen may come again, as after a jump of time.
        """
        self._newest_on.clear()
        self._newest_of.clear()
        self._suspects.clear()
        if seen_too:
            self._seen.clear()
