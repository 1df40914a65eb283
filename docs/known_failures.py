"""Draws the pictures of the model card's known failures from the recorded scans, with the weights that ship.

    python docs/known_failures.py

In every view the wide lines are the true axes of the first camera, the thin ones the estimated axes.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from relpose_ros.geometry import so3
from relpose_ros.inference.estimator import Estimator
from relpose_ros.network.crops import BOX_SCALE
from relpose_ros.replay.ground_truth import read_posed_views
from relpose_ros.views import Scan

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.views import View

    Picture = npt.NDArray[np.uint8]
    FloatArray = npt.NDArray[np.float64]

HERE = Path(__file__).resolve().parent
SIDE, GAP, LINE = 240, 8, 18
AXES = ((40, 40, 230), (40, 160, 40), (230, 90, 30))
"""Blue, green, red of the x, y and z axis."""


@dataclass(frozen=True)
class Failure:
    """Views of a recorded scan of which an estimate is made."""

    name: str
    bag: str
    views: tuple[int, ...]


FAILURES = (
    Failure("plain_mug", "ambiguous_mug", (0, 2, 4, 6)),
    Failure("front_and_back", "orbit", (0, 5, 27, 33)),
    Failure("wide_pair", "textured_object", (2, 6)),
)


def crop(view: View) -> Picture:
    """The square about the box, grey where the picture ends."""
    half = round(BOX_SCALE * max(view.box.width, view.box.height) / 2)
    x = round((view.box.x0 + view.box.x1) / 2) - view.origin[0]
    y = round((view.box.y0 + view.box.y1) / 2) - view.origin[1]
    padded = cv2.copyMakeBorder(view.image, half, half, half, half, cv2.BORDER_CONSTANT, value=(128,) * 3)
    square = padded[y : y + 2 * half, x : x + 2 * half, ::-1]
    return np.asarray(cv2.resize(square, (SIDE, SIDE), interpolation=cv2.INTER_AREA), np.uint8)


def draw_axes(picture: Picture, camera_from_object: FloatArray, width: int, length: float) -> None:
    """The object's axes about the middle of a crop, seen from far; those that point away first."""
    middle = np.full(2, SIDE / 2)
    for axis in np.argsort(-camera_from_object[2]):
        tip = middle + length * SIDE * camera_from_object[:2, axis]
        ends = [tuple(np.round(16 * end).astype(int).tolist()) for end in (middle, tip)]
        cv2.line(picture, ends[0], ends[1], (255, 255, 255), width + 2, cv2.LINE_AA, shift=4)
        cv2.line(picture, ends[0], ends[1], AXES[axis], width, cv2.LINE_AA, shift=4)


def draw(failure: Failure, estimator: Estimator) -> Picture:
    """A row of crops with true and estimated axes, and in words what was said of the scan."""
    (every,) = read_posed_views(HERE.parent / "bags" / failure.bag).values()
    chosen = [every[k] for k in failure.views]
    estimate = estimator.estimate(Scan(failure.bag, tuple(each.view for each in chosen)))
    first = chosen[0].camera_from_world[:, :3]
    pictures, lines = [], []
    for each, camera in zip(chosen, estimate.cameras, strict=True):
        true = each.camera_from_world[:, :3] @ first.T
        picture = crop(each.view)
        draw_axes(picture, true, 7, 0.36)
        draw_axes(picture, camera.object_from_camera.T, 2, 0.46)
        pictures += [picture, np.full((SIDE, GAP, 3), 255, np.uint8)]
        apart = np.degrees(so3.angle_between(true, np.eye(3)))
        off = np.degrees(so3.angle_between(camera.object_from_camera.T, true))
        lines.append("first view" if camera.view == 0 else f"{apart:.0f} deg on, off by {off:.0f}")
    row = np.hstack(pictures[:-1])
    said = textwrap.wrap(estimate.status, row.shape[1] // 8)
    page = np.full((SIDE + LINE * (len(said) + 1) + GAP, row.shape[1], 3), 255, np.uint8)
    page[:SIDE] = row
    for k, line in enumerate(lines):
        write(page, line, k * (SIDE + GAP), SIDE + LINE)
    for k, line in enumerate(said):
        write(page, line, 0, SIDE + LINE * (k + 2))
    return page


def write(page: Picture, line: str, x: int, y: int) -> None:
    """A line of text whose baseline begins at (x, y)."""
    cv2.putText(page, line, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (30, 30, 30), 1, cv2.LINE_AA)


def main() -> None:
    """Writes docs/failure_*.jpg."""
    estimator = Estimator.from_weights()
    for failure in FAILURES:
        file = HERE / f"failure_{failure.name}.jpg"
        cv2.imwrite(str(file), draw(failure, estimator), [cv2.IMWRITE_JPEG_QUALITY, 88])
        print(file.name)


if __name__ == "__main__":
    main()
