"""What lower precision and compilation give on this machine, and what they cost in accuracy.

    python -m benchmarks.precision [--threads 2] [--presets paper compact]

Everything is compared with float32 on the same inputs. The error of the energies is in standard deviations
of a pair's energy over rotations, because that, and no constant, is what a pair's distribution is made of.

What pays is kept: the backbone in bfloat16, as the parameter ``precision`` of node and replay. On a processor
with matrix units for it the published backbone takes half the time, and energies move by three hundredths of
their spread; the transformer and the scoring in bfloat16 too save less and cost ten times as much. int8 and
compiling save a sixth at most, and compiling takes half a minute at every start.

Compilation runs in a process of its own and is given up after a while: on some machines it takes many minutes
for the compact network, more than it could ever save on a robot.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import os
import platform
import signal
import subprocess
import sys
import warnings
from itertools import combinations
from typing import TYPE_CHECKING

import torch
from torch import nn
from tqdm import tqdm

from benchmarks.encoder import timed, words
from relpose_ros.geometry import so3_grid
from relpose_ros.network.checkpoint import SHIPPED_WEIGHTS, load_network, random_network
from relpose_ros.network.presets import PRESETS

if TYPE_CHECKING:
    from collections.abc import Callable

    from relpose_ros.network.relpose import RelPose

EXACT, COMPILED = "float32", "torch.compile"
VIEWS = 8
ROTATIONS = 1024


class Lowered:
    """One way to run a network: encoder and scoring as two calls from float32 to float32."""

    def __init__(
        self, network: RelPose, dtype: torch.dtype = torch.float32, *, autocast: bool = False
    ) -> None:
        self.network = network
        self.dtype = dtype
        self.autocast = autocast

    def encode(self, images: torch.Tensor, crops: torch.Tensor) -> object:
        with torch.autocast("cpu", torch.bfloat16, enabled=self.autocast):
            return self.network.encode(images.to(self.dtype), crops.to(self.dtype))

    def energies(self, features: object, i: list[int], j: list[int], rotations: torch.Tensor) -> torch.Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=self.autocast):
            contexts = self.network.pair_contexts(features, i, j)
            embeddings = self.network.embed_relative(rotations)
            parts = [self.network.pair_energies(context[None], embeddings) for context in contexts]
            return torch.cat(parts).float()


def ways(network: RelPose) -> dict[str, Callable[[], Lowered]]:
    def bfloat16() -> Lowered:
        return Lowered(copy.deepcopy(network).to(torch.bfloat16), torch.bfloat16)

    def bfloat16_backbone() -> Lowered:
        lowered = copy.deepcopy(network)
        lowered.backbone_in_bfloat16 = True
        return Lowered(lowered)

    def int8_linear() -> Lowered:
        from torch.ao.quantization import quantize_dynamic

        lowered = copy.deepcopy(network)
        # The energy's last two layers are merged by their weights, so they stay as they are.
        lowered.feature_extractor = quantize_dynamic(lowered.feature_extractor, {nn.Linear}, torch.qint8)
        return Lowered(lowered)

    def int8_weights() -> Lowered:
        lowered = copy.deepcopy(network)
        for module in lowered.modules():
            if isinstance(module, nn.Linear | nn.Conv2d):
                flat = module.weight.flatten(1)
                step = flat.abs().amax(1, keepdim=True).clamp_min(1e-30) / 127  # a row may be all zeros
                module.weight.copy_(((flat / step).round() * step).reshape(module.weight.shape))
        return Lowered(lowered)

    def compiled() -> Lowered:
        lowered = copy.deepcopy(network)
        lowered.feature_extractor.look = torch.compile(lowered.feature_extractor.look)
        lowered.feature_extractor.relate = torch.compile(lowered.feature_extractor.relate)
        lowered.pair_energies = torch.compile(lowered.pair_energies)
        return Lowered(lowered)

    return {
        EXACT: lambda: Lowered(network),
        "bfloat16 backbone": bfloat16_backbone,
        "bfloat16 autocast": lambda: Lowered(network, autocast=True),
        "bfloat16": bfloat16,
        "int8 linear, dynamic": int8_linear,
        "int8 stored weights": int8_weights,
        COMPILED: compiled,
    }


@torch.no_grad()
def compare(name: str, repeats: int, *, compiled: bool) -> None:
    """Prints a row for each way to run a preset: the compiled one alone, or all others."""
    shipped = SHIPPED_WEIGHTS.is_file() and name == "compact"
    network = load_network() if shipped else random_network(name, 0)
    size = network.preset.image_size
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(VIEWS, 3, size, size, generator=generator)
    crops = torch.rand(VIEWS, 3, generator=generator)
    rotations = torch.from_numpy(
        so3_grid.cell_rotations(2, range(0, so3_grid.size(2), 4))[:ROTATIONS]
    ).float()
    i, j = (list(side) for side in zip(*combinations(range(VIEWS), 2), strict=True))
    exact_features = exact_energies = None
    every = {
        way: make for way, make in ways(network).items() if way == EXACT or (way == COMPILED) == compiled
    }
    for way, make in tqdm(every.items(), desc=name, leave=False):
        label = f"{name:8} {way:21}"
        try:
            lowered = make()
            features = lowered.encode(images, crops)
            energies = lowered.energies(features, i, j, rotations)
        except Exception as err:  # a machine may lack a compiler or a kernel: that is the finding
            tqdm.write(f"{label} does not run here: {str(err).strip().splitlines()[0][:60]}")
            continue
        tokens = features.tokens.float()
        if exact_features is None or exact_energies is None:
            exact_features, exact_energies = tokens, energies
        if way == EXACT and compiled:
            continue
        feature_error = ((tokens - exact_features).norm() / exact_features.norm()).item()
        spread = exact_energies.std(-1, keepdim=True)
        difference = (energies - exact_energies) - (energies - exact_energies).mean(-1, keepdim=True)
        energy_error = (difference / spread).abs().max().item()
        same_best = (energies.argmax(-1) == exact_energies.argmax(-1)).float().mean().item()
        encode = words(timed(lambda: lowered.encode(images, crops), repeats))  # noqa: B023
        score = words(timed(lambda: lowered.energies(features, i, j, rotations), repeats))  # noqa: B023
        tqdm.write(f"{label} {encode}  {score}  {feature_error:9.1e} {energy_error:9.1e} {same_best:9.0%}")
        sys.stdout.flush()


def compare_compiled(name: str, repeats: int, threads: int, limit_s: float) -> None:
    """Prints the row of the compiled network, or that compiling took too long."""
    own = [sys.executable, "-m", "benchmarks.precision", "--presets", name, "--compiled-row"]
    own += ["--threads", str(threads), "--repeats", str(repeats)]
    # In a session of its own: the compiler starts processes, which must go with it.
    with subprocess.Popen(own, start_new_session=True) as process:
        try:
            process.wait(limit_s)
        except subprocess.TimeoutExpired:
            print(f"{name:8} {COMPILED:21} not done in {limit_s:.0f} s, given up", flush=True)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--presets", nargs="+", choices=list(PRESETS), default=list(PRESETS))
    parser.add_argument("--compile-limit", type=float, default=120, metavar="SECONDS", help="for compilation")
    parser.add_argument("--compiled-row", action="store_true", help="that row alone, in this process")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")  # of deprecations in the ways compared
    torch.set_num_threads(arguments.threads)
    if arguments.compiled_row:
        for name in arguments.presets:
            compare(name, arguments.repeats, compiled=True)
        os._exit(0)  # without waiting for what the compiler leaves behind
    print(f"torch {torch.__version__}, {platform.machine()}, {arguments.threads} threads, N = {VIEWS};")
    print(f"least (median) seconds of {arguments.repeats} after one to warm up\n")
    times = f"{'encoder, s':>20}  {f'{ROTATIONS} rotations, s':>20}"
    print(f"{'preset':8} {'way':21} {times}  {'features':>9} {'energies':>9} same best", flush=True)
    for name in arguments.presets:
        compare(name, arguments.repeats, compiled=False)
        compare_compiled(name, arguments.repeats, arguments.threads, arguments.compile_limit)


if __name__ == "__main__":
    main()
