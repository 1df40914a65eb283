"""The training loop: on one processor, one GPU, or several machines; stopped and resumed at will.

Whatever is random in a step is drawn from the seed, the step's number and the process's rank, and the
learning rate depends on the images seen. So a run that is resumed goes on as if it had never stopped.
"""

from __future__ import annotations

import copy
import csv
import json
import logging
import os
import signal
import threading
import time
from contextlib import nullcontext
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import distributed
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader

from relpose_ros.network.checkpoint import load_network, random_network, read_metadata, write_network
from relpose_ros.network.efficientnet import EfficientNetLite0
from relpose_ros.network.presets import Preset
from relpose_ros.training.checkpoints import LISTING, load_pieces, save_pieces
from relpose_ros.training.objective import Objective
from relpose_ros.training.pair_accuracy import ACCURACIES, pair_accuracy
from relpose_ros.training.settings import TrainingError, TrainingSettings, initial_network
from relpose_ros.training.steps import StepPlans, Steps

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from relpose_ros.training.batches import Scans
    from relpose_ros.training.objective import Batch, Targets

_LOG = logging.getLogger(__name__)
_BY_BUDGET, _BY_SIGNAL = 1, 2
_BACKBONE = "feature_extractor.feature_extractor."
"""How the names of its weights begin."""
MEASURED_VIEWS = 4
"""Of each held-out scan."""
CURVE = "curve.csv"
WEIGHTS = "weights.safetensors"
_COLUMNS = ("step", "images", "seconds", "images_per_second", "learning_rate", "max_angle")
_LOSSES = ("loss", "rotation_nats", "translation", "match_nats")


class Trainer:
    """A run in a folder: its curve, its latest checkpoint, and the weights averaged so far."""

    def __init__(
        self,
        settings: TrainingSettings,
        folder: Path,
        scans: Scans,
        held_out: Scans | None = None,
        *,
        device: str = "cpu",
        workers: int = 0,
        start_from: Path | None = None,
        compiled: bool = False,
    ) -> None:
        """Begin a run, or go on with the one in the folder.

        Under torchrun every process makes one of these with the same arguments; gloo or NCCL joins them.

        Args:
            settings: May differ from those of the checkpoint, for instance to end a run sooner.
            folder: Of the run, made if it is missing.
            scans: To learn from.
            held_out: To measure on, other objects.
            device: Of this process; "cuda" alone is, under torchrun, each process's own GPU.
            workers: Processes beside this one that prepare batches; what they prepare does not depend on it.
            start_from: Weights of this network to begin with; the images they have seen count as seen. A run
                that has a checkpoint goes on with that.
            compiled: Whether to compile the step first: minutes, for half as many images again afterwards.

        Raises:
            TrainingError: The checkpoint is damaged, or it or the weights are of another network; there is no
                such device, or no folder can be made.
            NetworkFileError: The weights cannot be read.
            PretrainedError: The weights that the backbone begins with are not installed.
        """
        self.settings = settings
        self.folder = folder
        self._workers = workers
        self._batches: Iterator[tuple[Batch, Targets]] | None = None
        self._device = _own_device(device)
        _require(self._device)
        self._rank, self._processes = _join(self._device)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as err:
            text = f"{folder} cannot be the folder of a run: {err.strerror}; name another."
            raise TrainingError(text) from err
        goes_on = (folder / LISTING).exists()
        network = random_network(settings.network, settings.seed) if goes_on else initial_network(settings)
        self.network = network.to(self._device).train()
        self.average = copy.deepcopy(network).eval().requires_grad_(requires_grad=False)
        if settings.pretrained_backbone:
            network.feature_extractor.feature_extractor.requires_grad_(requires_grad=False)
        self._check_fit(scans, held_out)
        trained = [p for p in self.network.parameters() if p.requires_grad]
        decayed = [p for p in trained if p.ndim > 1]
        plain = [p for p in trained if p.ndim <= 1]
        groups: list[tuple[list[torch.nn.Parameter], float, float]] = [
            (decayed, settings.weight_decay, 1.0),
            (plain, 0.0, 1.0),
        ]
        if backbone := self._trained_backbone():
            groups.append((backbone, 0.0, settings.backbone_rate))
            if scans.map_shapes:
                scans = scans.first_maps()
            if held_out is not None and held_out.map_shapes:
                held_out = held_out.first_maps()
        self._scans, self._held_out = scans, held_out
        self._rate_shares = [share for _, _, share in groups]
        self._optimizer = torch.optim.AdamW(
            [{"params": parameters, "weight_decay": decay} for parameters, decay, _ in groups],
            lr=settings.learning_rate,
            betas=(0.9, 0.98),  # a longer memory of squared gradients let early steps run away
        )
        self._scaler = torch.amp.GradScaler(enabled=settings.precision == "float16")
        objective = Objective(self.network, settings.objective)
        self._objective: torch.nn.Module = objective
        if self._processes > 1:
            # Ablations leave parts of the network unused.
            self._objective = DistributedDataParallel(objective, find_unused_parameters=True)
        if compiled:
            self._objective.compile()
        self.step = 0
        self.images = 0
        self._began: int | None = None
        """Images that the weights had seen which were given to begin with; None: they were random."""
        self._seconds = 0.0
        self._unlogged: list[torch.Tensor] = []
        """Losses of the steps since the curve's latest row."""
        if goes_on:
            self._resume()
        elif start_from is not None:
            self._begin_with(start_from)
        if not goes_on and self._rank == 0:
            (folder / CURVE).unlink(missing_ok=True)  # of a run that ended before its first checkpoint
        self._require_same_start()

    @property
    def finished(self) -> bool:
        """Whether all images have been seen."""
        return self.images >= self.settings.images

    def run(
        self,
        budget_s: float | None = None,
        *,
        log_every: int = 50,
        check_every: int = 1000,
        progress: bool = True,
    ) -> None:
        """Train until the run is finished or the time is up, then write a checkpoint and the weights.

        SIGINT (Ctrl-C) and SIGTERM end it after the step at hand; a second SIGINT ends it at once.

        Args:
            budget_s: Wall-clock seconds, None for no limit.
            log_every: Steps between rows of the curve.
            check_every: Steps between measurements on the held-out scans, checkpoints and weights.
            progress: Whether to show a progress bar on stderr.

        Raises:
            KeyboardInterrupt: It was ended by a signal; all steps are saved.
        """
        from tqdm import tqdm

        started = time.monotonic()
        before = self._seconds
        last = (self.images, started)
        saved, end = -1, 0
        hidden = not progress or self._rank > 0
        with (
            _StopRequest() as stop,
            tqdm(total=self.settings.images, initial=self.images, unit="image", disable=hidden) as bar,
        ):
            while not self.finished and not (end := self._end(stop, started, budget_s)):
                was = self.images
                self.train_step()
                bar.update(self.images - was)
                self._seconds = before + time.monotonic() - started
                check = self.step % check_every == 0 or self.finished
                if self.step % log_every == 0 or check:
                    means = torch.stack(self._unlogged).mean(0).tolist()
                    self._unlogged.clear()
                    speed = (self.images - last[0]) / (time.monotonic() - last[1])
                    bar.set_postfix_str(f"rotation {means[1]:.2f}, {speed:.0f} images/s")
                    if check:
                        self.save()  # a measurement that fails must not take the steps with it
                        saved = self.step
                    self._log(means, speed, self.measure() if check else {})
                    last = (self.images, time.monotonic())
            if saved != self.step:
                self.save()
        if end == _BY_SIGNAL:
            _LOG.info("stopped at step %d; the same command goes on.", self.step)
            raise KeyboardInterrupt

    def train_step(self) -> torch.Tensor:
        """One update. -> (4,) total loss, rotation, translation, matches."""
        settings = self.settings
        rate = self.learning_rate()
        for group, share in zip(self._optimizer.param_groups, self._rate_shares, strict=True):
            group["lr"] = rate * share
        batch, targets = self._next_batch()
        losses = self._losses(batch, targets)
        self._optimizer.zero_grad()
        torch.autograd.backward(self._scaler.scale(losses[0]))
        self._scaler.unscale_(self._optimizer)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), settings.gradient_norm)
        self._scaler.step(self._optimizer)
        self._scaler.update()
        self.step += 1
        seen = batch.crop_parameters.shape[0] * batch.crop_parameters.shape[1] * self._processes
        self.images += seen
        keep = float(np.exp(-seen / settings.average_images))
        if self._began is None:
            # Young weights are forgotten sooner, or the average would keep the random ones.
            keep = min(self.step / (self.step + 10), keep)
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.network.parameters()), 1 - keep)
        self._unlogged.append(losses.detach())
        return losses.detach()

    def learning_rate(self) -> float:
        """Of the coming step: a linear rise, a plateau, a linear fall to 0."""
        s = self.settings
        rise = min(1.0, (self.images - (self._began or 0) + s.batch_images) / max(s.warmup_images, 1))
        left = max(0.0, 1 - self.images / s.images)
        return s.learning_rate * rise * (min(1.0, left / s.decay) if s.decay > 0 else 1.0)

    def max_angle(self) -> float:
        """Largest angle between views and the one they surround, for the coming step, degrees."""
        return self.settings.max_angle(self.images)

    def measure(self, views: int = MEASURED_VIEWS, count: int = 32) -> dict[str, float]:
        """Accuracy of single pairs on the held-out scans, by the averaged weights; empty without any."""
        if self._held_out is None or self._rank > 0:
            return {}
        return pair_accuracy(self.average, self._held_out, views=views, count=count)

    def save(self) -> None:
        """Write checkpoint and averaged weights, by the first process alone."""
        if self._rank == 0:
            state = {
                "network": self.network.state_dict(),
                "average": self.average.state_dict(),
                "optimizer": self._optimizer.state_dict(),
                "scaler": self._scaler.state_dict(),
                "step": self.step,
                "images": self.images,
                "began": self._began,
                "seconds": self._seconds,
                "unlogged": self._unlogged,
                "preset": asdict(self.settings.network),
            }
            save_pieces(state, self.folder)
            write_network(
                self.average,
                self.folder / WEIGHTS,
                {
                    "source": "relpose_ros train",
                    "images_seen": str(self.images),
                    "training": json.dumps(asdict(self.settings)),
                },
            )

    def _resume(self) -> None:
        state = load_pieces(self.folder)
        # As JSON a tuple and a list are the same. What has come to presets since a checkpoint was written had
        # its default before; what has gone no longer matters.
        fields = asdict(Preset("")).keys()
        stored = asdict(Preset("")) | {
            name: state["preset"][name] for name in fields & state["preset"].keys()
        }
        if json.dumps(stored) != json.dumps(asdict(self.settings.network)):
            text = (
                f"the checkpoint in {self.folder} is of another network than {self._asked()}; "
                "name another folder."
            )
            raise TrainingError(text)
        if len(state["optimizer"]["param_groups"]) != len(self._rate_shares):
            text = (
                f"the checkpoint in {self.folder} is of a run whose backbone was"
                f"{' not' if self.settings.backbone_rate else ''} trained; "
                "name another folder, and its weights to start from."
            )
            raise TrainingError(text)
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._scaler.load_state_dict(state["scaler"])
        self.step, self.images, self._seconds = state["step"], state["images"], state["seconds"]
        self._began = state.get("began")  # missing in files of before it could be anything but random
        self._unlogged = [each.to(self._device) for each in state.get("unlogged", [])]
        if self._rank == 0:
            _cut_curve(self.folder / CURVE, self.step)

    def _begin_with(self, weights: Path) -> None:
        begun = load_network(weights)
        if begun.preset != self.settings.network:
            text = f"{weights} holds another network than {self._asked()}; name its preset and variants."
            raise TrainingError(text)
        state = begun.state_dict()
        if self.settings.pretrained_backbone:
            own = {
                name: value for name, value in self.network.state_dict().items() if name.startswith(_BACKBONE)
            }
            # In the full precision in which it looks, where the file has half of it.
            same = {name: value for name, value in own.items() if value.half().equal(state[name].half())}
            kept = any(each is not None and each.map_shapes for each in (self._scans, self._held_out))
            if len(same) < len(own) and kept and not self.settings.backbone_rate:
                text = (
                    f"the backbone of {weights} was trained, and the shards hold what it saw before; "
                    "train it further (--backbone-rate), or give it shards of images."
                )
                raise TrainingError(text)
            state |= same
        for network in (self.network, self.average):
            network.load_state_dict(state)
        self.images = self._began = int(read_metadata(weights).get("images_seen", "0"))
        if self.finished:
            asked = self.settings.images
            text = f"{weights} has seen {self.images} images, all in all {asked} are asked for (--images)."
            raise TrainingError(text)

    def _require_same_start(self) -> None:
        """Refuse processes of which some found a checkpoint and some did not."""
        if self._processes == 1:
            return
        own = torch.tensor([self.step, self.images], device=self._device)
        others = [torch.empty_like(own) for _ in range(self._processes)]
        distributed.all_gather(others, own)
        if any(not other.equal(own) for other in others):
            text = (
                f"the processes begin at different steps ({', '.join(str(int(o[0])) for o in others)}): "
                f"{self.folder} must be one folder that all machines share."
            )
            raise TrainingError(text)

    def _check_fit(self, scans: Scans, held_out: Scans | None) -> None:
        """Refuse scans of too few views, and maps of a backbone that this network reads not, or trains."""
        most = self.settings.max_views
        if scans.views < most:
            text = (
                f"there are shards of scans of {scans.views} views only, and up to {most} are drawn of each: "
                "leave them out, or make others."
            )
            raise TrainingError(text)
        if held_out is not None and held_out.views < MEASURED_VIEWS:
            text = (
                f"there are held-out scans of {held_out.views} views only; measuring takes {MEASURED_VIEWS}."
            )
            raise TrainingError(text)
        shapes = self.network.feature_extractor.summarised_shapes
        for each in (scans, *([] if held_out is None else [held_out])):
            if each.map_shapes and not (self.settings.pretrained_backbone and each.map_shapes == shapes):
                side = self.settings.network.image_size
                text = (
                    f"the shards hold features of another backbone than that of {self._asked()}, or of "
                    f"images not {side} pixels wide; give it shards of images."
                )
                raise TrainingError(text)

    def _trained_backbone(self) -> list[torch.nn.Parameter]:
        """What is trained of a pretrained backbone."""
        if self.settings.backbone_rate == 0:
            return []
        encoder = self.network.feature_extractor
        backbone = encoder.feature_extractor
        first = min(encoder.summarised_shapes)
        trained = backbone.pointwise_behind(first) if isinstance(backbone, EfficientNetLite0) else []
        if not trained:
            text = f"{self._asked()} has no pretrained layers behind what it reads; name no rate for them."
            raise TrainingError(text)
        for each in trained:
            each.requires_grad = True
        return trained

    def _asked(self) -> str:
        return "'" + " + ".join([self.settings.preset, *self.settings.variants]) + "'"

    def _next_batch(self) -> tuple[Batch, Targets]:
        if self._batches is None:
            steps = Steps(self.settings, self._scans, self._rank)
            plan = StepPlans(self.settings, self.step, self.images, self._processes)
            loader: DataLoader[Any] = DataLoader(
                steps,
                batch_size=None,
                sampler=plan,
                num_workers=self._workers,
                worker_init_fn=_leave_the_terminal,
            )
            self._batches = iter(loader)
        batch, targets = next(self._batches)
        return batch, targets

    def _losses(self, batch: Batch, targets: Targets) -> torch.Tensor:
        precision = getattr(torch, self.settings.precision)
        mixed = precision is not torch.float32
        with torch.autocast(self._device.type, precision) if mixed else nullcontext():
            losses: torch.Tensor = self._objective(
                batch.looks_on(self._device),
                batch.crop_parameters.to(self._device),
                targets.to(self._device),
            )
        return losses

    def _end(self, stop: _StopRequest, started: float, budget_s: float | None) -> int:
        """Why the run ends before the coming step; 0: it does not."""
        late = budget_s is not None and time.monotonic() - started > budget_s
        end = _BY_SIGNAL if stop.asked else _BY_BUDGET if late else 0
        if self._processes > 1:
            # All stop at the same step, or those that go on would wait for ever.
            flag = torch.tensor(float(end), device=self._device)
            distributed.all_reduce(flag, distributed.ReduceOp.MAX)
            end = int(flag.item())
        return end

    def _log(self, means: Sequence[float], speed: float, accuracy: dict[str, float]) -> None:
        if self._rank > 0:
            return
        path = self.folder / CURVE
        row = {
            "step": self.step,
            "images": self.images,
            "seconds": round(self._seconds, 1),
            "images_per_second": round(speed, 1),
            "learning_rate": f"{self.learning_rate():.3g}",
            "max_angle": self.max_angle(),
            **{name: round(value, 4) for name, value in zip(_LOSSES, means, strict=True)},
            **{name: round(value, 4) for name, value in accuracy.items()},
        }
        columns = [*_COLUMNS, *_LOSSES, *ACCURACIES]
        new = not path.exists() or path.stat().st_size == 0
        with path.open("a", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, columns)
            if new:
                writer.writeheader()
            writer.writerow(row)


class _StopRequest:
    """Whether SIGINT or SIGTERM came while it is entered. A second SIGINT does what it always did.

    A second SIGTERM does not: torchrun sends one after the terminal's SIGINT, and kills what lingers itself.
    """

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> _StopRequest:
        if threading.current_thread() is threading.main_thread():  # no other may ask for signals
            self._before = {each: signal.signal(each, self._ask) for each in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def _ask(self, number: int, _frame: object) -> None:
        self.asked = True
        if number == signal.SIGINT:
            signal.signal(number, self._before[number])


def _leave_the_terminal(_worker: int) -> None:
    """What ends a command goes to all processes of its group; the step at hand still needs its batch."""
    os.setsid()


def _own_device(device: str) -> torch.device:
    try:
        own = torch.device(device)
    except RuntimeError as err:
        text = f"{device!r} is no device to train on; name cpu, cuda, or one of several as cuda:1."
        raise TrainingError(text) from err
    if own.type == "cuda" and own.index is None and "LOCAL_RANK" in os.environ:
        own = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
    return own


def _require(device: torch.device) -> None:
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as err:
        why = str(err).splitlines()[0].rstrip(".")
        text = f"the device {device} cannot be used here: {why}. Name another, such as cpu."
        raise TrainingError(text) from err


def _join(device: torch.device) -> tuple[int, int]:
    """Rank and number of processes; joins those that torchrun started."""
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    if processes > 1 and not distributed.is_initialized():
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return (distributed.get_rank(), processes) if processes > 1 else (0, 1)


def _cut_curve(path: Path, step: int) -> None:
    """Forget what was logged after the checkpoint: those steps are taken again."""
    if path.exists():
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.reader(stream))
        with path.open("w", newline="", encoding="utf-8") as stream:
            csv.writer(stream).writerows([*rows[:1], *(row for row in rows[1:] if int(row[0]) <= step)])
