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
    """Brings images and camera infos of one stamp together, whichever comes first.

    A camera info stays after it was used: the same picture may come raw and compressed. What waits longest
    goes when there is too much of it, and so does what lies ahead of a clock that jumped backwards.
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
        self._queues: dict[tuple[str, Kind], _Queue] = {}

    def add(self, kind: Kind, arrival: Arrival, camera: str) -> list[ImagePair]:
        """Take a message in; give back each pair that it completes."""
        stamp_ns = arrival.source.stamp_ns
        self._queue(camera, kind).follow_clock(stamp_ns, self.backward_jump_ns)
        if kind == "camera_info":
            self._queue(camera, kind).put(arrival, self.limit)
            images = [self._queue(camera, each).messages.pop(stamp_ns, None) for each in _IMAGE_KINDS]
            return [ImagePair(image, arrival) for image in images if image is not None]
        info = self._queue(camera, "camera_info").messages.get(stamp_ns)
        if info is not None:
            return [ImagePair(arrival, info)]
        self.images_alone += self._queue(camera, kind).put(arrival, self.limit)
        return []

    def clear(self) -> None:
        """Forget everything that waits."""
        self._queues.clear()

    def waiting(self) -> int:
        """How many images wait for their camera info."""
        return sum(len(queue.messages) for (_, kind), queue in self._queues.items() if kind in _IMAGE_KINDS)

    def _queue(self, camera: str, kind: Kind) -> _Queue:
        return self._queues.setdefault((camera, kind), _Queue())


class _Queue:
    """Messages of one kind and camera by stamp, in the order of their arrival."""

    def __init__(self) -> None:
        self.messages: OrderedDict[int, Arrival] = OrderedDict()
        self._newest_ns = 0
        self._suspect_ns: int | None = None

    def put(self, arrival: Arrival, limit: int) -> int:
        """Let a message wait. -> how many others made room for it."""
        self.messages[arrival.source.stamp_ns] = arrival
        surplus = max(0, len(self.messages) - limit)
        for _ in range(surplus):
            self.messages.popitem(last=False)
        return surplus

    def follow_clock(self, stamp_ns: int, backward_jump_ns: int) -> None:
        """Forget what lies in the future once two messages in order agree that time jumped back."""
        if stamp_ns > self._newest_ns - backward_jump_ns:
            self._newest_ns = max(self._newest_ns, stamp_ns)
            self._suspect_ns = None
        elif self._suspect_ns is None or stamp_ns <= self._suspect_ns:
            self._suspect_ns = stamp_ns
        else:
            self._newest_ns, self._suspect_ns = stamp_ns, None
            for ahead in [each for each in self.messages if each > stamp_ns]:
                del self.messages[ahead]
