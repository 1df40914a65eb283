"""How well scans do whose neighbouring views overlap: photographs as a robot takes them that moves on.

    python -m benchmarks.arcs CAPTURE... [--views 3 4 6 8] [--masks]

An arc begins at a photograph and goes on, each time, to the nearest one by its angle that is 15 degrees or
more from all before it; it ends where none lies within 45 degrees. Measured is the estimator as it ships.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from relpose_ros.captures.opening import open_captures
from relpose_ros.evaluation import metrics, trust
from relpose_ros.evaluation.baselines import Estimated
from relpose_ros.evaluation.protocol import posed_views
from relpose_ros.geometry import so3
from relpose_ros.inference.estimator import Estimator

if TYPE_CHECKING:
    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]

NEAREST_DEG, FURTHEST_DEG = 15.0, 45.0
ARCS = 8
"""Of one capture and number of views, spread over its photographs."""


def arcs(rotations: FloatArray, views: int) -> list[list[int]]:
    """Arcs of so many views, positions in camera_from_world (M, 3, 3); their beginnings spread over all."""
    angles = np.degrees(so3.angle_between(rotations[:, None], rotations[None]))
    found = []
    for start in range(len(rotations)):
        arc = [start]
        while len(arc) < views:
            free = (angles[arc].min(0) >= NEAREST_DEG) & (angles[arc[-1]] <= FURTHEST_DEG)
            if not free.any():
                break
            arc.append(int(np.where(free, angles[arc[-1]], np.inf).argmin()))
        if len(arc) == views:
            found.append(arc)
    kept = np.linspace(0, len(found) - 1, min(ARCS, len(found))).round().astype(int)
    return [found[k] for k in kept]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", type=Path, nargs="*", help="capture folders with poses")
    parser.add_argument("--views", type=int, nargs="+", default=[3, 4, 6, 8])
    parser.add_argument("--masks", action="store_true", help="use masks where there are some")
    arguments = parser.parse_args()
    if not arguments.captures:
        print("Nothing to measure: name captures with poses.")
        return
    method = Estimated("relpose", Estimator.from_weights())
    print(
        "rotation @5 and @15 of pairs; scans called enough, and of these with a pair more than 15 degrees off"
    )
    print(f"{'capture':20} {'N':>2} {'scans':>5} {'@5':>6} {'@15':>6} {'enough':>6} {'wrong':>5}")
    captures = [capture for folder in arguments.captures for capture in open_captures(folder)]
    totals: dict[int, list[tuple[FloatArray, trust.Statements]]] = {views: [] for views in arguments.views}
    for capture in captures:
        sequence = posed_views(capture, masked=arguments.masks)
        poses = sequence.camera_from_world
        # The same views in all arcs: an estimator matches a pair once.
        held = [sequence.view(k) for k in range(len(poses))]
        for views in arguments.views:
            measured = []
            for arc in tqdm(arcs(poses[:, :, :3], views), desc=f"{capture.name}, N = {views}", leave=False):
                scan = [held[k] for k in arc]
                found = method.poses(scan)
                assert found.estimate is not None
                rotations, translations = poses[arc, :, :3], poses[arc, :, 3]
                errors = metrics.rotation_errors(found.rotations, rotations)
                measured.append((errors, trust.statements(found.estimate, scan, rotations, translations)))
            show(capture.name, views, measured)
            totals[views] += measured
    for views, measured in totals.items():
        show("all", views, measured)


def show(name: str, views: int, measured: list[tuple[FloatArray, trust.Statements]]) -> None:
    if not measured:
        return
    errors = np.concatenate([each for each, _ in measured])
    enough = [said for _, said in measured if said.enough]
    print(
        f"{name:20} {views:2} {len(measured):5} {(errors <= 5).mean():6.1%} {(errors <= 15).mean():6.1%} "
        f"{len(enough):6} {sum(said.wrong for said in enough):5}",
        flush=True,
    )


if __name__ == "__main__":
    main()
