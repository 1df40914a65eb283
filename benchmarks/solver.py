"""What an estimate costs beside its encoder and beside RelPose++'s own procedure, N = 2 to 8.

    python -m benchmarks.solver [--threads 2] [--presets paper compact] [--published-scale 1.0]
    python -m benchmarks.solver --search-table
    python -m benchmarks.solver --recipes 200

Weights are random, with energies made smooth. In the rows "contradict" they have peaks, and no two pairs
agree on anything: the hardest case for the solver. In the rows "agree" the same energies are flattened until
no pair has anything against the poses found: the work of a scan whose pairs agree. Scans lie between the two.
Only the network and the solver are timed, with no other evidence. The encoder's seconds are those from views
to tokens, as the estimator spends them.

Published procedure: rebuilt from its description and run in full at N = 3; for the other N its evaluations
are counted and priced at the seconds per evaluation measured there. It scores with our own, cheaper head,
which flatters it.

``--search-table`` prints how often each way to search a pair finds its highest energy. ``--recipes`` compares
the solver's joint score with that of a slow, dense search, for so many random scans of 2 to 8 views: some
seconds each.

Each preset runs in a process of its own, whose peak memory is then that of the largest N so far; the
published procedure is priced in another one.
"""

from __future__ import annotations

import argparse
import math
import platform
import resource
import statistics
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import numpy as np
import torch
from tqdm import tqdm

from benchmarks import recipes
from benchmarks.encoder import timed
from benchmarks.references import best_of_pair, exhaustive, published, published_evaluations
from relpose_ros.inference.estimator import Estimator
from relpose_ros.inference.evidence import EvidenceSettings
from relpose_ros.inference.global_rotations import solve
from relpose_ros.inference.pair_distribution import SearchSettings, search
from relpose_ros.inference.pair_energies import GridEmbeddings, PairEnergies
from relpose_ros.network.checkpoint import random_network
from relpose_ros.network.features import SceneFeatures
from relpose_ros.network.presets import PRESETS
from relpose_ros.views import MAX_VIEWS, MIN_VIEWS, BoundingBox, Scan, View

if TYPE_CHECKING:
    from relpose_ros.network.relpose import RelPose

HEADER = (
    f"{'preset':8} {'pairs':10} {'N':>2}  {'encoder, s':>17}  {'estimate, s':>17}  {'ratio':>5}  "
    f"{'one view more, s':>17}  {'published, s':>13}  {'times':>6}  peak, MiB"
)
TOLERANCE = 1e-3
"""Nats below the reference that are no miss: scores are sums of some ten, in single precision."""
SEARCHES = [
    SearchSettings(level=level, widths=widths, widest=1)
    for level, widths in [
        (1, ()),
        (1, (64,)),
        (1, (8, 8)),
        (1, (64, 64)),
        (1, (128, 128)),
        (1, (8, 8, 8)),
        (1, (64, 64, 64)),
        (1, (8, 8, 8, 8)),
        (1, (64, 24, 8, 8)),
        (1, (32, 32, 32, 32)),
        (1, (64, 64, 64, 64)),
        (1, (512, 192, 64, 64)),
        (2, ()),
        (2, (64,)),
        (2, (256,)),
    ]
]


def peaked_network(preset: str, seed: int) -> RelPose:
    """Random weights whose energies are smooth over the rotations, and have peaks of ten nats and more."""
    network = random_network(preset, seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for layer in (network.embed_feature, network.embed_query, *network.layers[1::2], network.layers[4]):
            deviation = math.sqrt(2 / layer.in_features)
            layer.weight.copy_(deviation * torch.randn(layer.weight.shape, generator=generator))
    recipes.peak(network)
    return network


def noise_views(count: int) -> list[View]:
    """Views of 640 x 480 noise."""
    generator = np.random.default_rng(0)
    return [
        View(generator.integers(0, 256, (480, 640, 3), np.uint8), BoundingBox(150, 80, 430, 400), 640, 480)
        for _ in range(count)
    ]


def fresh(views: list[View]) -> list[View]:
    """The same pictures as views that no estimator has seen."""
    return [View(view.image, view.box, view.full_width, view.full_height) for view in views]


def words(seconds: tuple[float, float]) -> str:
    return f"{seconds[0]:.3f} ({seconds[1]:.3f})".rjust(17)


def spread(seconds: list[float]) -> tuple[float, float]:
    return min(seconds), statistics.median(seconds)


@torch.no_grad()
def rows(name: str, repeats: int, per_evaluation: float) -> None:
    """Prints the rows of one preset."""
    network = peaked_network(name, 0)
    views = noise_views(MAX_VIEWS)
    counts = range(MIN_VIEWS, MAX_VIEWS + 1)
    with tqdm(total=2 * len(counts), leave=False) as bar:
        for kind in ("contradict", "agree"):
            if kind == "agree":
                network.layers[4].weight *= 0.01
            estimator = Estimator(network, evidence=EvidenceSettings(use="network"))
            totals = []
            for count in counts:
                bar.set_description(f"{name}, {kind}, N = {count}")
                estimator.estimate(Scan("warm-up", tuple(fresh(views[:count]))))

                def encode(count: int = count, estimator: Estimator = estimator) -> object:
                    return estimator.features(Scan("encoder", tuple(fresh(views[:count]))))

                encoder = timed(encode, repeats)
                estimate, more = estimated(estimator, views[:count], repeats)
                theirs = encoder[0] + per_evaluation * published_evaluations(count)
                totals.append(estimate[0])
                peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
                bar.write(
                    f"{name:8} {kind:10} {count:2}  {words(encoder)}  {words(estimate)}  "
                    f"{estimate[0] / encoder[0]:5.2f}  {words(more)}  {theirs:12.1f}"
                    f"{' ' if count == 3 else '*'}  {theirs / estimate[0]:6.0f}  {peak:9.0f}"
                )
                sys.stdout.flush()
                bar.update()
            power = np.polyfit(np.log(counts), np.log(totals), 1)[0]
            bar.write(f"{name:8} {kind:10} grows as N^{power:.1f}\n")


def estimated(
    estimator: Estimator, views: list[View], repeats: int
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Seconds of an estimate from new views, and of one where all but the last were seen before."""
    whole, more = [], []
    for _ in range(repeats):
        held = fresh(views)
        start = time.perf_counter()
        estimator.estimate(Scan("whole", tuple(held)))
        whole.append(time.perf_counter() - start)
        last = fresh(views[-1:])
        start = time.perf_counter()
        estimator.estimate(Scan("more", tuple(held[:-1] + last)))
        more.append(time.perf_counter() - start)
    return spread(whole), spread(more)


def inputs(network: RelPose, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Crops of noise, and where they lie."""
    size = network.preset.image_size
    images = torch.randn(MAX_VIEWS, 3, size, size, generator=torch.Generator().manual_seed(0))
    crops = torch.rand(MAX_VIEWS, 3, generator=torch.Generator().manual_seed(1))
    return images[:count], crops[:count]


@torch.no_grad()
def price(name: str, scale: float) -> float:
    """Seconds per evaluated energy in the published procedure, from a run with three views."""
    network = peaked_network(name, 0)
    images, crops = inputs(network, 3)
    features = network.relate(network.look(images), crops)
    energies = PairEnergies.of(network, features, len(images))
    start = time.perf_counter()
    _, _, evaluated = published(energies, np.random.default_rng(0), scale)
    return (time.perf_counter() - start) / evaluated


@torch.no_grad()
def search_table(pairs: int) -> None:
    """Prints how often each way to search finds the highest energy of a pair, and what it evaluates."""
    network = peaked_network("paper", 0)
    tokens = torch.randn(2 * pairs, network.preset.token_width, generator=torch.Generator().manual_seed(2))
    i, j = torch.arange(pairs), torch.arange(pairs) + pairs
    features = SceneFeatures(tokens, None)
    energies = PairEnergies(network.energy_head(), network.pair_contexts(features, i, j), i, j, 2 * pairs)
    dense = [
        best_of_pair(energies, pair, level=3)[1] for pair in tqdm(range(pairs), desc="dense", leave=False)
    ]
    optimum = torch.tensor(dense)
    grid = GridEmbeddings(network)
    print(f"{pairs} pairs; found: at most 0.05 nats below a dense evaluation of 36,864 cells and lattices\n")
    print("level  widths          evaluated a pair  found  worst miss, nats")
    for settings in tqdm(SEARCHES, desc="searches", leave=False):
        found = search(energies, grid, settings).mode_energies[:, 0]
        misses = (optimum - found).clamp_min(0)
        evaluated = 72 * 8**settings.level + sum(8 * width for width in settings.widths)
        evaluated += settings.modes * (settings.refinement_steps + 1)
        widths = ", ".join(map(str, settings.widths)) or "-"
        share = float((misses <= 0.05).double().mean())
        tqdm.write(
            f"{settings.level:5}  {widths:14}  {evaluated:16}  {share:5.0%}  {float(misses.max()):16.2f}"
        )
        sys.stdout.flush()


@torch.no_grad()
def compare_recipes(count: int) -> None:
    """Prints how the solver's joint scores compare with those of the exhaustive reference."""
    network = random_network("paper", 0)
    recipes.fill(network)
    recipes.peak(network)
    grid = GridEmbeddings(network)
    above: dict[int, list[float]] = {views: [] for views in range(MIN_VIEWS, MAX_VIEWS + 1)}
    with tqdm(total=count, unit="recipe") as bar:
        for seed in range(count):
            views = MIN_VIEWS + seed % (MAX_VIEWS - MIN_VIEWS + 1)
            energies = PairEnergies.of(network, network.encode(*recipes.inputs(seed, views)), views)
            found = float(solve(energies, search(energies, grid)).scores[0])
            above[views].append(found - exhaustive(energies, level=2)[1])
            if above[views][-1] < -TOLERANCE:
                bar.write(f"seed {seed}, N = {views}: {-above[views][-1]:.3f} nats below the reference")
            bar.update()
    print(f"joint score against the exhaustive reference; at or above: not {TOLERANCE} nats below\n")
    print(" N  recipes  at or above  higher by 0.01  least  median, nats")
    for views, each in above.items():
        if each:
            good = sum(gain >= -TOLERANCE for gain in each)
            higher = sum(gain > 0.01 for gain in each)
            least, median = min(each), statistics.median(each)
            print(f"{views:2}  {len(each):7}  {good:11}  {higher:14}  {least:5.2f}  {median:12.2f}")
    gains = [gain for each in above.values() for gain in each]
    share = sum(gain >= -TOLERANCE for gain in gains) / len(gains)
    print(f"\n{share:.1%} of {len(gains)} recipes at or above the exhaustive reference")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--presets", nargs="+", choices=list(PRESETS), default=list(PRESETS))
    parser.add_argument(
        "--published-scale", type=float, default=1.0, help="share of its proposals that is run"
    )
    parser.add_argument("--search-table", action="store_true", help="only the table of searches")
    parser.add_argument("--pairs", type=int, default=60, help="in the table of searches")
    parser.add_argument(
        "--recipes", type=int, metavar="K", help="only the comparison with the exhaustive reference"
    )
    parser.add_argument("--price", action="store_true", help="only the price of an evaluation, in seconds")
    parser.add_argument(
        "--rows", type=float, metavar="PRICE", help="only the rows of the presets, in this process"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if not 0 < arguments.published_scale <= 1:
        parser.error(f"--published-scale is a share above 0 and up to 1, not {arguments.published_scale}")
    if arguments.price:
        print(*(price(name, arguments.published_scale) for name in arguments.presets))
        return
    if arguments.rows:
        for name in arguments.presets:
            rows(name, arguments.repeats, arguments.rows)
        return
    print(f"torch {torch.__version__}, {platform.machine()}, {arguments.threads} threads, float32")
    if arguments.recipes:
        compare_recipes(arguments.recipes)
        return
    if not arguments.search_table:
        print(f"least (median) seconds of {arguments.repeats} after one to warm up; * by counted evaluations")
        if not math.isclose(arguments.published_scale, 1):
            print(f"published procedure priced on {arguments.published_scale:.0%} of its proposals")
        print(f"\n{HEADER}", flush=True)
        for name in arguments.presets:
            own = [sys.executable, "-m", "benchmarks.solver", "--presets", name]
            own += ["--threads", str(arguments.threads), "--repeats", str(arguments.repeats)]
            print(f"{name}: pricing the published procedure", file=sys.stderr)
            pricing = [*own, "--price", "--published-scale", str(arguments.published_scale)]
            priced = subprocess.run(pricing, check=True, capture_output=True, text=True).stdout
            subprocess.run([*own, "--rows", priced.strip()], check=True)
    search_table(arguments.pairs)


if __name__ == "__main__":
    main()
