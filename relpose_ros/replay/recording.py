"""What a replay keeps of each object: its views as small pictures, and every estimate."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from relpose_ros.estimates import Verdict
from relpose_ros.inference.outlines import known_rays, rays_of
from relpose_ros.views import Scan

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.estimates import FloatArray, ScanEstimate
    from relpose_ros.scanning.scanner import Result
    from relpose_ros.views import View

PICTURE_SIDE = 208
"""Pixels of a view's small picture: sharp at the size the report shows it, on a dense screen too."""
PICTURE_MARGIN = 1.15
"""How much more than the box a picture shows: as much as the network sees (RelPose++ crops)."""

WHY_DECLINED = {
    "first": "came when the scan was full",
    "spread": "came from no new direction, or right after such a picture",
}
"""What is told of the pictures that never had a place, by the policy of which views stay."""


@dataclass(frozen=True, eq=False)
class ViewRecord:
    """A view that was accepted."""

    view: View
    """Without its pixels."""
    picture: bytes
    """JPEG of the square about the box, ``PICTURE_SIDE`` pixels wide."""
    corners: FloatArray
    """(4, 2): x/z and y/z of the rays through the picture's corners, clockwise from the top left."""


@dataclass(frozen=True, eq=False)
class EstimateRecord:
    """One estimate and when it was made."""

    log_time_ns: int
    """Log time of the message that completed its newest view."""
    views: tuple[int, ...]
    """Positions in the recording's views, in the scan's order."""
    scan: Scan
    """Its views without their pixels."""
    estimate: ScanEstimate


@dataclass
class Recording:
    """Everything that happened to one object."""

    object_id: str
    views: list[ViewRecord] = field(default_factory=list)
    """In the order in which estimates first used them."""
    estimates: list[EstimateRecord] = field(default_factory=list)
    newest_scan: Scan | None = None
    """The last estimate's scan, pixels and all."""
    keep: str = "spread"
    """Which views stay where more come than may be held, see ``ScanSettings``."""
    declined: int = 0
    """Pictures that never had a place."""
    # Weak, so that a recording of an hour does not hold an hour of images.
    _positions: WeakKeyDictionary[View, int] = field(default_factory=WeakKeyDictionary, repr=False)

    def add(self, result: Result, log_time_ns: int) -> None:
        """Note an estimate and those of its views that are new."""
        for view in result.scan.views:
            if view not in self._positions:
                self._positions[view] = len(self.views)
                self.views.append(_record(view))
        self.newest_scan = result.scan
        views = tuple(self._positions[view] for view in result.scan.views)
        scan = Scan(result.scan.object_id, tuple(self.views[k].view for k in views))
        self.estimates.append(EstimateRecord(log_time_ns, views, scan, result.estimate))

    def arrivals(self) -> str:
        """How many pictures came and what became of them, in words."""
        held = len(self.views)
        if not self.declined:
            return f"{held} views were used"
        came, why = held + self.declined, WHY_DECLINED[self.keep]
        return f"{came} pictures came, {held} were held at some time, {self.declined} {why}"

    def lost_enough(self) -> str:
        """Which estimates said enough, in words, where the last one says so no more; else empty."""
        said = [each.estimate.verdict == Verdict.ENOUGH for each in self.estimates]
        if not any(said) or said[-1]:
            return ""
        runs: list[list[int]] = []
        for number, enough in enumerate(said, start=1):
            if enough and number > 1 and said[number - 2]:
                runs[-1][1] = number
            elif enough:
                runs.append([number, number])
        spans = ", ".join(f"{first}" if first == last else f"{first} to {last}" for first, last in runs)
        noun = "estimate" if sum(said) == 1 else "estimates"
        return f"{noun} {spans} of {len(said)} said enough, the last does not: a planner stops at the first"


def _record(view: View) -> ViewRecord:
    side = PICTURE_MARGIN * max(view.box.width, view.box.height)
    centre = np.array([view.box.x0 + view.box.x1, view.box.y0 + view.box.y1]) / 2
    # Whole pixels, so that a cut without interpolation shows exactly what the corners' rays enclose.
    first = np.floor(centre - side / 2).astype(int)
    last = np.ceil(centre + side / 2).astype(int)
    corners = np.array([[first[0], first[1]], [last[0], first[1]], [last[0], last[1]], [first[0], last[1]]])
    rays = rays_of(view, corners.astype(float))
    if not known_rays(rays).all():  # beyond what the lens shows: as if it bent nothing
        rays = rays_of(replace(view, distortion=None), corners.astype(float))
    return ViewRecord(
        view=replace(view, image=np.empty((0, 0, 3), np.uint8), mask=None),
        picture=_picture(view.image, first - np.array(view.origin), last - np.array(view.origin)),
        corners=rays,
    )


def _picture(image: npt.NDArray[np.uint8], first: npt.NDArray[np.int_], last: npt.NDArray[np.int_]) -> bytes:
    """JPEG of the part of an image from ``first`` to ``last`` (column, row), grey outside the image."""
    height, width = image.shape[:2]
    size = last - first
    cut = np.full((size[1], size[0], 3), 128, np.uint8)
    x0, y0 = np.clip(first, 0, (width, height))
    x1, y1 = np.clip(last, 0, (width, height))
    if x1 > x0 and y1 > y0:
        cut[y0 - first[1] : y1 - first[1], x0 - first[0] : x1 - first[0]] = image[y0:y1, x0:x1]
    shrinks = max(size) > PICTURE_SIDE
    small = cv2.resize(
        cut,
        (PICTURE_SIDE, PICTURE_SIDE),
        interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR,
    )
    _, encoded = cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
    return encoded.tobytes()
