"""The camera poses that a robot tells, kept until the views they belong to are estimated."""

from __future__ import annotations

from collections import Counter, OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from relpose_ros.scanning.incoming import Source
    from relpose_ros.views import RobotPose, View

KEPT = 1000
"""Poses that are of no view held: ten seconds of a robot that tells its state at 100 Hz."""


@dataclass(eq=False)
class _Entry:
    source: Source
    pose: RobotPose
    claimed: bool = False
    """Whether a view had its stamp, held or not."""


class RobotPoses:
    """Poses by stamp, which is all that tells to which view one belongs. Either may come first."""

    def __init__(self) -> None:
        """Make one without poses."""
        self._entries: OrderedDict[int, _Entry] = OrderedDict()
        self._passed_over: OrderedDict[int, None] = OrderedDict()
        """Stamps of views that nobody needs, the latest of them."""

    def put(self, source: Source, pose: RobotPose, held: Collection[int]) -> tuple[bool, list[Source]]:
        """Keep a pose, the newer one of a stamp; but none without a covariance instead of one with it.

        Args:
            source: Where it came from, and its stamp.
            pose: What it says.
            held: Stamps of the views held, whose poses do not go.

        Returns:
            Whether it is news, and the source of the one that had to go though no view ever had its stamp.
        """
        old = self._entries.get(source.stamp_ns)
        if old is not None and (_same(old.pose, pose) or old.pose.stated > pose.stated):
            return False, []
        claimed = source.stamp_ns in self._passed_over or (old is not None and old.claimed)
        self._entries[source.stamp_ns] = _Entry(source, pose, claimed)
        if len(self._entries) <= KEPT + len(held):
            return True, []
        oldest = next(stamp_ns for stamp_ns in self._entries if stamp_ns not in held)
        return True, [entry.source for entry in self._pop([oldest]) if not entry.claimed]

    def claim(self, stamp_ns: int) -> Source | None:
        """Take note of a view with a stamp. Gives the source of its pose the first time there is one."""
        entry = self._entries.get(stamp_ns)
        if entry is None or entry.claimed:
            return None
        entry.claimed = True
        return entry.source

    def pass_over(self, stamp_ns: int) -> None:
        """Take note of a view that nobody needs: that its pose has no other one is no mistake."""
        if (entry := self._entries.get(stamp_ns)) is not None:
            entry.claimed = True
        self._passed_over[stamp_ns] = None
        if len(self._passed_over) > KEPT:
            self._passed_over.popitem(last=False)

    def of(self, views: Iterable[View]) -> tuple[RobotPose | None, ...]:
        """The pose of each view, None where there is none; nothing at all where no view has one.

        Cameras that are triggered together share a stamp, and a pose names no camera: theirs are left out.
        """
        views = tuple(views)
        stamps = Counter(view.stamp_ns for view in views)
        found = [self._entries.get(view.stamp_ns) if stamps[view.stamp_ns] == 1 else None for view in views]
        return tuple(None if each is None else each.pose for each in found) if any(found) else ()

    def forget(self, held: Collection[int]) -> None:
        """Forget all poses but those of some stamps."""
        self._pop([stamp_ns for stamp_ns in self._entries if stamp_ns not in held])

    def _pop(self, stamps: Iterable[int]) -> list[_Entry]:
        return [self._entries.pop(stamp_ns) for stamp_ns in stamps]


def _same(one: RobotPose, other: RobotPose) -> bool:
    return one.frame_id == other.frame_id and all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("position", "robot_from_camera", "covariance")
    )
