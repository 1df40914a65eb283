"""What matches and refinement add to an estimate, in seconds, for 2 to 8 views of a recorded object.

    python -m benchmarks.evidence [--threads 2] [--bag bags/textured_object] [--repeats 3]

Side by side in one run: all views new, and one view more on a scan whose other views are known. Least seconds
of the repeats; in brackets what is added to the network alone.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import torch
from tqdm import tqdm

from relpose_ros.inference.calibration import Calibration
from relpose_ros.inference.estimator import Estimator
from relpose_ros.inference.evidence import EvidenceSettings
from relpose_ros.network.checkpoint import load_network, read_metadata
from relpose_ros.replay.replay import replay
from relpose_ros.views import MIN_VIEWS, Scan

if TYPE_CHECKING:
    from relpose_ros.estimates import ScanEstimate
    from relpose_ros.views import View

USES = ("network", "pairs", "refine")


class Listener:
    """An estimator that remembers the last scan it was asked for."""

    def __init__(self, estimator: Estimator) -> None:
        self.views: tuple[View, ...] = ()
        self._estimator = estimator

    def estimate(self, scan: Scan) -> ScanEstimate:
        self.views = scan.views
        return self._estimator.estimate(scan)


def views_of(bag: Path, estimator: Estimator) -> tuple[View, ...]:
    """The views that the scan of a bag ends with."""
    listener = Listener(estimator)
    with tempfile.TemporaryDirectory() as folder:
        replay(bag, Path(folder) / "replay", estimator=listener)
    return listener.views


def seconds(estimator: Estimator, views: tuple[View, ...]) -> float:
    start = time.perf_counter()
    estimator.estimate(Scan("benchmark", views))
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--bag", type=Path, default=Path("bags/textured_object"))
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    network = load_network(None)
    calibration = Calibration.from_json(read_metadata(None)["calibration"])
    views = views_of(arguments.bag, Estimator(network, calibration))
    print(f"{'':2}  {'all views new, s (added)':^42}  {'one view more, s (added)':^42}")
    print(f"{'N':>2}  {''.join(f'{use:>14}' for use in USES * 2)}")
    for count in tqdm(range(MIN_VIEWS, len(views) + 1), leave=False):
        least = {use: [float("inf")] * 2 for use in USES}
        for _ in range(arguments.repeats):
            for use in USES:
                estimator = Estimator(network, calibration, EvidenceSettings(use))  # type: ignore[arg-type]
                # Other objects each time: an estimator keeps what it knows of a view.
                fresh = tuple(replace(view) for view in views[:count])
                whole = seconds(estimator, fresh)
                newcomer = (*fresh[:-1], replace(fresh[-1]))
                times = whole, seconds(estimator, newcomer)
                least[use] = [min(pair) for pair in zip(least[use], times, strict=True)]
        cells = [
            f"{least[use][which]:.2f} ({least[use][which] - least['network'][which]:+.2f})".rjust(14)
            for which in range(2)
            for use in USES
        ]
        tqdm.write(f"{count:2}  {''.join(cells)}")


if __name__ == "__main__":
    main()
