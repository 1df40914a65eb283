"""Seconds and memory of the network, N = 2 to 8: all views new, and one view more.

    python -m benchmarks.encoder [--threads 2] [--presets paper compact]

Views are looked at one after another, on all threads; the estimator gives each view of the compact network a
thread of its own, and what that takes `benchmarks/solver.py` tells.

Each preset runs in a process of its own, whose peak memory is then that of the largest N so far.
"""

from __future__ import annotations

import argparse
import platform
import resource
import statistics
import subprocess
import sys
import time
from itertools import combinations
from typing import TYPE_CHECKING

import torch
from tqdm import tqdm

from relpose_ros.network.checkpoint import random_network
from relpose_ros.network.features import ViewFeatures
from relpose_ros.network.presets import PRESETS
from relpose_ros.views import MAX_VIEWS, MIN_VIEWS

if TYPE_CHECKING:
    from collections.abc import Callable

COLUMNS = ("all views, s", "one view more, s", "all pairs, s")
HEADER = f"{'preset':8} {'N':>2}  {'  '.join(f'{column:>20}' for column in COLUMNS)}  peak, MiB"


def timed(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Least and median seconds, after one call to warm up."""
    call()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return min(seconds), statistics.median(seconds)


def words(seconds: tuple[float, float]) -> str:
    return f"{seconds[0]:.4f} ({seconds[1]:.4f})".rjust(20)


@torch.no_grad()
def rows(name: str, repeats: int) -> None:
    """Prints the rows of one preset."""
    network = random_network(name, 0)
    size = network.preset.image_size
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(MAX_VIEWS, 3, size, size, generator=generator)
    crops = torch.rand(MAX_VIEWS, 3, generator=generator)
    kept = [network.look(images[view : view + 1])[0] for view in range(MAX_VIEWS)]
    for count in tqdm(range(MIN_VIEWS, MAX_VIEWS + 1), desc=name, leave=False):

        def look(view: int) -> ViewFeatures:
            # One at a time: a view's features must not depend on its company.
            return network.look(images[view : view + 1])[0]

        def first(count: int = count) -> object:
            return network.relate(ViewFeatures.stack([look(view) for view in range(count)]), crops[:count])

        def more(count: int = count) -> object:
            return network.relate(ViewFeatures.stack([*kept[: count - 1], look(count - 1)]), crops[:count])

        features = network.relate(ViewFeatures.stack(kept[:count]), crops[:count])
        i, j = zip(*combinations(range(count), 2), strict=True)
        columns = [
            words(timed(call, repeats))
            for call in (first, more, lambda: network.pair_contexts(features, list(i), list(j)))  # noqa: B023
        ]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        tqdm.write(f"{name:8} {count:2}  {'  '.join(columns)}  {peak:9.0f}")
        sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--presets", nargs="+", choices=list(PRESETS), default=list(PRESETS))
    parser.add_argument("--rows", action="store_true", help="the rows of the presets, in this process")
    arguments = parser.parse_args()
    if arguments.rows:
        torch.set_num_threads(arguments.threads)
        for name in arguments.presets:
            rows(name, arguments.repeats)
        return
    print(f"torch {torch.__version__}, {platform.machine()}, {arguments.threads} threads, float32;")
    print(f"least (median) seconds of {arguments.repeats} after one to warm up\n")
    print(HEADER, flush=True)
    for name in arguments.presets:
        numbers = ["--threads", str(arguments.threads), "--repeats", str(arguments.repeats)]
        own = [sys.executable, "-m", "benchmarks.encoder", "--rows", "--presets", name, *numbers]
        subprocess.run(own, check=True)


if __name__ == "__main__":
    main()
