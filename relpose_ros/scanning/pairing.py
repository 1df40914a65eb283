"""Pictures and the camera infos that belong to them, brought together by their stamps."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from relpose_ros.scanning.incoming import Kind, Source

_IMAGE_KINDS: tuple[Kind, ...] = ("image", "compressed")


@dataclass(frozen=True, eq=False)
class Arrival:
    """A message on its way to become half of a view."""

    message: Any
    source: Source


@dataclass(frozen=True, eq=False)
class ImagePair:
    """A picture and the camera info of the same stamp."""

    image: Arrival
    info: Arrival


class Pairing:
    """Brings images and camera infos of one stamp and frame together, whichever comes first.

    Another frame is another camera; where one of them names none, the stamp decides. A camera info stays
    after it was used: the same picture may come raw and compressed. What waits longest goes when there is too
    much of it, and so does what lies ahead of a clock that jumped backwards.
    """

    def __init__(self, limit: int, backward_jump_ns: int) -> None:
        """Make an empty one.

        Args:
            limit: Most messages that wait, of each kind and camera.
            backward_jump_ns: How far back a stamp must lie to count as a jump, and not as late.
        """
        self.limit = limit
        self.backward_jump_ns = backward_jump_ns
        self.images_alone = 0
        """Images that made room for later ones before a camera info of their stamp came."""
        self.frames_apart: tuple[str, str] | None = None
        """Frames of the latest image and camera info of one stamp that differ; None where later ones met."""
        self._queues: dict[tuple[str, Kind], _Queue] = {}

    def add(self, kind: Kind, arrival: Arrival, camera: str) -> list[ImagePair]:
        """Take a message in; give back each pair that it completes."""
        own = self._queue(camera, kind)
        own.follow_clock(arrival.source.stamp_ns, self.backward_jump_ns)
        is_info = kind == "camera_info"
        counterparts = [self._queue(camera, each) for each in (_IMAGE_KINDS if is_info else ("camera_info",))]
        found = [each for queue in counterparts for each in queue.of(arrival.source, remove=is_info)]
        if found:
            self.frames_apart = None
        elif others := [each for queue in counterparts for each in queue.frames_at(arrival.source.stamp_ns)]:
            frames = arrival.source.frame_id, others[0]
            self.frames_apart = (frames[1], frames[0]) if is_info else frames
        if is_info:
            own.put(arrival, self.limit)
            return [ImagePair(image, arrival) for image in found]
        if not found:
            self.images_alone += own.put(arrival, self.limit)
        return [ImagePair(arrival, info) for info in found[:1]]

    def clear(self) -> None:
        """Forget everything that waits."""
        self._queues.clear()
        self.frames_apart = None

    def waiting(self) -> int:
        """How many images wait for their camera info."""
        return sum(len(queue.messages) for (_, kind), queue in self._queues.items() if kind in _IMAGE_KINDS)

    def _queue(self, camera: str, kind: Kind) -> _Queue:
        return self._queues.setdefault((camera, kind), _Queue())


class _Queue:
    """Messages of one kind and camera by stamp and frame, in the order of their arrival."""

    def __init__(self) -> None:
        self.messages: OrderedDict[tuple[int, str], Arrival] = OrderedDict()
        self._newest_ns = 0
        self._suspect_ns: int | None = None

    def put(self, arrival: Arrival, limit: int) -> int:
        """Let a message wait. -> how many others made room for it."""
        self.messages[_key(arrival.source)] = arrival
        surplus = max(0, len(self.messages) - limit)
        for _ in range(surplus):
            self.messages.popitem(last=False)
        return surplus

    def of(self, source: Source, *, remove: bool) -> list[Arrival]:
        """What belongs to a message of the other kind: of its stamp and frame, or of its stamp alone."""
        key = _key(source)
        keys = [key] if key in self.messages else []
        keys = keys or [each for each in self.messages if each[0] == key[0] and not (each[1] and key[1])]
        return [self.messages.pop(each) if remove else self.messages[each] for each in keys]

    def frames_at(self, stamp_ns: int) -> list[str]:
        """The frames of the messages of a stamp."""
        return [frame for stamp, frame in self.messages if stamp == stamp_ns]

    def follow_clock(self, stamp_ns: int, backward_jump_ns: int) -> None:
        """Forget what lies in the future once two messages in order agree that time jumped back."""
        if stamp_ns > self._newest_ns - backward_jump_ns:
            self._newest_ns = max(self._newest_ns, stamp_ns)
            self._suspect_ns = None
        elif self._suspect_ns is None or stamp_ns <= self._suspect_ns:
            self._suspect_ns = stamp_ns
        else:
            self._newest_ns, self._suspect_ns = stamp_ns, None
            for ahead in [each for each in self.messages if each[0] > stamp_ns]:
                del self.messages[ahead]


def _key(source: Source) -> tuple[int, str]:
    return source.stamp_ns, source.frame_id.lstrip("/")  # as ROS 1 wrote frames, and bags of it still do
