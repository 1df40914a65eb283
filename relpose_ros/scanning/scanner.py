"""Messages in, estimates out: the one scanner behind the node and the replay. It knows no ROS."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

if TYPE_CHECKING:
    from relpose_ros.estimates import ScanEstimate
    from relpose_ros.scanning.settings import ScanSettings
    from relpose_ros.views import Scan

Kind = Literal["object_view", "image", "compressed", "camera_info"]
"""ObjectView; sensor_msgs/Image; sensor_msgs/CompressedImage; sensor_msgs/CameraInfo."""


class SupportsEstimate(Protocol):
    """What a scanner asks of an estimator."""

    def estimate(self, scan: Scan) -> ScanEstimate:
        """The poses of a scan of two views or more."""


@dataclass(frozen=True)
class Receipt:
    """What became of a message."""

    accepted: bool
    """Whether a view of it is held now."""
    object_id: str
    """Whose view it was; empty where no view came of it (yet)."""
    reason: str
    """A sentence for the log: why not, or what else happened; empty where there is nothing to say."""
    rejected: bool = False
    """Whether the message was bad. A message can be neither accepted nor rejected: it waits for its
    counterpart, was delivered twice, or the scan has views enough."""


@dataclass(frozen=True, eq=False)
class Result:
    """An estimate and the views it was made from."""

    scan: Scan
    estimate: ScanEstimate


@dataclass(frozen=True)
class TopicStatistics:
    """What came in on one topic."""

    received: int
    used: int
    """Messages of which a view came (an image and its camera info count both)."""
    rejected: int
    last_reason: str
    """Why the last rejected message was rejected; empty where none was."""


@dataclass(frozen=True)
class ScanStatistics:
    """The state of one scan."""

    views: int
    estimates: int
    dropped: int
    """Views that the keep policy or a reset has let go, or never took."""
    latency_s: float | None
    """From receiving the newest view to having its estimate; None before the first estimate."""
    status: str
    """The last estimate's verdict in words; empty before the first."""
    weakest_pair: tuple[int, int] | None
    """Views i and j of the last estimate's least certain pair; None before the first."""
    weakest_probability: float | None
    """Probability that this pair is within 15 degrees of its strongest mode; None before the first."""


@dataclass(frozen=True)
class Statistics:
    """What a node's diagnostics tell."""

    topics: Mapping[str, TopicStatistics]
    scans: Mapping[str, ScanStatistics]
    """By object id."""
    waiting: int
    """Images and camera infos that wait for their counterpart."""
    failed: int
    """Estimates that ended in an error."""
    last_failure: str
    """The last such error; empty where there was none."""


class Scanner:
    """Collects the views of each object and estimates every scan that changed.

    ``receive`` may be called from several threads while another one runs ``estimate_pending``. Events worth
    a line in the log go to the standard logger ``relpose_ros``; reasons of single messages are in their receipts.
    """

    def __init__(
        self, estimator: SupportsEstimate, settings: ScanSettings, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Make a scanner that holds nothing yet.

        Args:
            estimator: Makes the estimates.
            settings: Which views to hold, and how long.
            clock: Seconds, for latencies alone.
        """

    def receive(self, kind: Kind, topic: str, message: Any, camera: str = "") -> Receipt:
        """Take one message in. Never raises for a bad message: the receipt says what was wrong.

        Args:
            kind: What the message is.
            topic: Where it came from, as the user knows it.
            message: Any object with the fields of its kind (rclpy's or rosbags', or another's).
            camera: Whose image or camera info it is, where there are several cameras: only messages
                of one camera are paired.
        """
        raise NotImplementedError

    def pending(self) -> bool:
        """Whether ``estimate_pending`` has work to do."""
        raise NotImplementedError

    def estimate_pending(self) -> list[Result]:
        """Estimate each scan that changed since its last estimate and has two views or more.

        All views that came meanwhile are taken together. Returns after one round: call it again while
        ``pending()``. A result whose scan was reset while it was made is dropped; so is a trial of a
        further view (keep policy "spread") that the scan does not take.
        """
        raise NotImplementedError

    def estimate_now(self, object_id: str | None = None) -> list[Result]:
        """Estimate a scan, or all, changed or not. Empty where none has two views."""
        raise NotImplementedError

    def reset(self, reason: str, object_id: str | None = None) -> int:
        """Forget the views of one object, or of all, and what waits for its counterpart.

        Args:
            reason: Why, for the log.
            object_id: Whose views; None for all.

        Returns:
            How many views were forgotten.
        """
        raise NotImplementedError

    def drop_last_view(self, object_id: str | None = None) -> Receipt:
        """Forget the newest view of an object, or of the object that was seen last.

        ``accepted`` tells whether there was one, ``reason`` what was dropped.
        """
        raise NotImplementedError

    def statistics(self) -> Statistics:
        """A snapshot for diagnostics."""
        raise NotImplementedError
