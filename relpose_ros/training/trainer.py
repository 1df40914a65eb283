"""The training loop: on one processor, one GPU, or several machines; stopped and resumed at will.

Whatever is random in a step is drawn from the seed, the step's number and the process's rank, and the
learning rate depends on the images seen. So a run that is resumed goes on as if it had never stopped.
"""

from __future__ import annotations

import copy
import csv
import hashlib
import io
import json
import os
import time
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import distributed
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, Dataset

from relpose_ros.errors import RelPoseError
from relpose_ros.geometry import so3, so3_grid
from relpose_ros.network.checkpoint import load_network, random_network, read_metadata, write_network
from relpose_ros.network.efficientnet import EfficientNetLite0
from relpose_ros.network.presets import Preset, named_preset
from relpose_ros.training.batches import Augmentation, Scans, make_batch
from relpose_ros.training.imagenet import imagenet_backbone
from relpose_ros.training.objective import (
    Batch,
    Objective,
    ObjectiveSettings,
    Targets,
    make_targets,
    scene_features,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    import numpy.typing as npt

    from relpose_ros.network.features import SceneFeatures
    from relpose_ros.network.relpose import RelPose
    from relpose_ros.training.objective import Looks

    State = dict[str, Any]
    FloatArray = npt.NDArray[np.float64]
    BestRotations = Callable[[RelPose, SceneFeatures, list[int], list[int]], FloatArray]
    """(P, 3, 3) camera_j_from_camera_i of the pairs of one scan."""

PIECE_BYTES = 16 * 2**20
"""Size of the pieces a checkpoint is cut into, so that it passes through stores that refuse large files."""
_BACKBONE = "feature_extractor.feature_extractor."
"""How the names of its weights begin."""
MEASURED_VIEWS = 4
"""Of each held-out scan."""
CURVE = "curve.csv"
WEIGHTS = "weights.safetensors"
_COLUMNS = ("step", "images", "seconds", "images_per_second", "learning_rate", "max_angle")
_LOSSES = ("loss", "rotation_nats", "translation", "match_nats")


class TrainingError(RelPoseError):
    """Training cannot start or go on."""


@dataclass(frozen=True)
class TrainingSettings:
    """How a network is trained. `settings_for` gives those of a preset."""

    preset: str = "compact"
    variants: tuple[str, ...] = ()
    """Ablations by their names in `relpose_ros.network.presets.VARIANTS`."""
    images: int = 600_000
    """Images seen in the whole run, each time an image is seen counting once."""
    batch_images: int = 64
    """Images a step and process: as many scans as fit."""
    min_views: int = 2
    max_views: int = 8
    learning_rate: float = 6e-4
    warmup_images: int = 12_000
    decay: float = 0.4
    """Share of the run, at its end, over which the learning rate falls to 0."""
    weight_decay: float = 0.01
    gradient_norm: float = 1.0
    average_images: int = 20_000
    """Images over which the averaged weights, those that are measured and written, forget."""
    curriculum: tuple[tuple[float, float], ...] = ((0.0, 45.0), (0.25, 90.0), (0.5, 180.0))
    """(share of the run, degrees): views of a scan lie within an angle of one of them, which is drawn
    for each step between the first of these and the one that the run has come to."""
    backbone_rate: float = 0.0
    """Learning rate of a pretrained backbone as a share of the others'; 0 leaves it as it is. Its pointwise
    convolutions learn, behind the first map that is read: on CPUs the others would take twice the time."""
    precision: str = "bfloat16"
    """Of the forward pass: float32, bfloat16, or float16 (GPU)."""
    objective: ObjectiveSettings = field(default_factory=ObjectiveSettings)
    augmentation: Augmentation = field(default_factory=Augmentation)
    seed: int = 0

    @property
    def network(self) -> Preset:
        """The preset with its variants."""
        return named_preset(self.preset, self.variants)

    @property
    def pretrained_backbone(self) -> bool:
        """Whether the backbone begins with the weights of `relpose_ros.training.imagenet`."""
        return self.network.backbone == "efficientnet_lite0"


def settings_for(preset: str, variants: Sequence[str] = ()) -> TrainingSettings:
    """The published run for ``paper``, ours for ``compact``, and the same run for their variants.

    Raises:
        PresetError: There is no such preset or variant.
    """
    network = named_preset(preset, variants)
    if preset == "paper":
        settings = TrainingSettings(
            preset="paper",
            images=800_000 * 48 * 8,
            batch_images=48 * 8,
            learning_rate=1e-5,
            warmup_images=0,
            decay=0.0,
            curriculum=((0.0, 180.0),),
        )
    else:
        settings = TrainingSettings(
            preset=preset,
            precision="float32",  # few CPUs have another that is sooner
            objective=ObjectiveSettings(
                uniform_rotations=256, near_rotations=128, pairs=8, match_weight=0.5, match_places=40
            ),
        )
    objective = settings.objective
    if network.rotation == "regression":
        # One rotation is predicted and none are compared: drawing many would be work for nothing.
        objective = replace(objective, uniform_rotations=1, near_rotations=0)
    return replace(settings, variants=tuple(variants), objective=objective)


def initial_network(settings: TrainingSettings) -> RelPose:
    """What a run begins with: weights drawn from its seed, and the backbone's own where it has some.

    Raises:
        PretrainedError: Those are not installed.
    """
    network = random_network(settings.network, settings.seed)
    if settings.pretrained_backbone:
        network.feature_extractor.feature_extractor.load_state_dict(imagenet_backbone().state_dict())
    return network


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
            TrainingError: The checkpoint is damaged, or it or the weights are of another network.
            NetworkFileError: The weights cannot be read.
            PretrainedError: The weights that the backbone begins with are not installed.
        """
        self.settings = settings
        self.folder = folder
        self._workers = workers
        self._batches: Iterator[tuple[Batch, Targets]] | None = None
        self._device = _own_device(device)
        self._rank, self._processes = _join(self._device)
        folder.mkdir(parents=True, exist_ok=True)
        goes_on = (folder / "checkpoint.json").exists()
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

        Args:
            budget_s: Wall-clock seconds, None for no limit.
            log_every: Steps between rows of the curve.
            check_every: Steps between measurements on the held-out scans, checkpoints and weights.
            progress: Whether to show a progress bar on stderr.
        """
        from tqdm import tqdm

        started = time.monotonic()
        before = self._seconds
        last = (self.images, started)
        hidden = not progress or self._rank > 0
        with tqdm(total=self.settings.images, initial=self.images, unit="image", disable=hidden) as bar:
            while not self.finished and not self._out_of_time(started, budget_s):
                was = self.images
                self.train_step()
                bar.update(self.images - was)
                self._seconds = before + time.monotonic() - started
                check = self.step % check_every == 0
                if self.step % log_every == 0 or check:
                    means = torch.stack(self._unlogged).mean(0).tolist()
                    self._unlogged.clear()
                    now = time.monotonic()
                    speed = (self.images - last[0]) / (now - last[1])
                    last = (self.images, now)
                    bar.set_postfix_str(f"rotation {means[1]:.2f}, {speed:.0f} images/s")
                    if check:
                        self.save()  # a measurement that fails must not take the steps with it
                    self._log(means, speed, self.measure() if check else {})
        self.save()

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
        left = 1 - self.images / s.images
        return s.learning_rate * rise * (min(1.0, left / s.decay) if s.decay > 0 else 1.0)

    def max_angle(self) -> float:
        """Largest angle between views and the one they surround, for the coming step, degrees."""
        return _max_angle(self.settings, self.images)

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
            text = f"{weights} has seen {self.images} images, all in all {asked} are asked for: ask for more."
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
            steps = _Steps(self.settings, self._scans, self._rank)
            plan = _Plans(self.settings, self.step, self.images, self._processes)
            loader: DataLoader[Any] = DataLoader(
                steps, batch_size=None, sampler=plan, num_workers=self._workers
            )
            self._batches = iter(loader)
        batch, targets = next(self._batches)
        return batch, targets

    def _losses(self, batch: Batch, targets: Targets) -> torch.Tensor:
        precision = getattr(torch, self.settings.precision)
        mixed = precision is not torch.float32
        with torch.autocast(self._device.type, precision) if mixed else nullcontext():
            losses: torch.Tensor = self._objective(
                _looks(batch, self._device),
                batch.crop_parameters.to(self._device),
                _moved(targets, self._device),
            )
        return losses

    def _out_of_time(self, started: float, budget_s: float | None) -> bool:
        if budget_s is None:
            return False
        late = time.monotonic() - started > budget_s
        if self._processes > 1:
            # All stop at the same step, or those that go on would wait for ever.
            flag = torch.tensor(float(late), device=self._device)
            distributed.all_reduce(flag, distributed.ReduceOp.MAX)
            late = bool(flag.item())
        return late

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
        new = not path.exists()
        with path.open("a", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, columns)
            if new:
                writer.writeheader()
            writer.writerow(row)


@dataclass(frozen=True)
class _Plan:
    """What a step needs to be drawn, wherever that happens."""

    step: int
    views: int
    max_angle: float


class _Plans:
    """The plans of all steps from one on. Every process has the same, so that none waits for another."""

    def __init__(self, settings: TrainingSettings, step: int, images: int, processes: int) -> None:
        self._settings, self._step, self._images, self._processes = settings, step, images, processes

    def __iter__(self) -> Iterator[_Plan]:
        settings, step, images = self._settings, self._step, self._images
        while images < settings.images:
            generator = np.random.default_rng([settings.seed, step])
            views = int(generator.integers(settings.min_views, settings.max_views + 1))
            # Near views go on being practised when far ones have begun.
            angle = float(generator.uniform(settings.curriculum[0][1], _max_angle(settings, images)))
            yield _Plan(step, views, angle)
            images += _scans_of(settings, views) * views * self._processes
            step += 1


class _Steps(Dataset[tuple[Batch, Targets]]):
    """Batch and targets of a planned step: a function of the plan, the seed and the rank alone."""

    def __init__(self, settings: TrainingSettings, scans: Scans, rank: int) -> None:
        self._settings, self._scans, self._rank = settings, scans, rank

    def __getitem__(self, plan: _Plan) -> tuple[Batch, Targets]:
        settings = self._settings
        generator = np.random.default_rng([settings.seed, plan.step, self._rank])
        batch = make_batch(
            self._scans,
            _scans_of(settings, plan.views),
            plan.views,
            plan.max_angle,
            generator,
            settings.augmentation,
        )
        frame = settings.network.translation_frame
        return batch, make_targets(batch, settings.objective, generator, translation_frame=frame)


def _scans_of(settings: TrainingSettings, views: int) -> int:
    return max(1, settings.batch_images // views)


def _max_angle(settings: TrainingSettings, images: int) -> float:
    share = images / settings.images
    return max((start, angle) for start, angle in settings.curriculum if start <= share)[1]


BINS = ((0.0, 30.0), (30.0, 60.0), (60.0, 180.0))
"""Degrees between the true orientations of two views, by which their accuracy is told."""
ACCURACIES = (
    "pair@15",
    "pair@30",
    "pair_median",
    "identity@15",
    *(f"pair@15_{low:g}-{high:g}" for low, high in BINS),
)


@torch.no_grad()
def pair_accuracy(
    network: RelPose, scans: Scans, *, views: int = 4, count: int = 32, level: int = 2
) -> dict[str, float]:
    """How often a pair's best rotation is right, for all pairs of scans drawn always alike.

    The best on a grid where the network scores rotations, else what it regresses.

    Quick, and without the solver: to watch a run, not to compare methods with.

    Args:
        network: To measure.
        scans: Held out.
        views: Views a scan, drawn from all of them.
        count: Scans.
        level: Of the rotation grid: 2 has cells of 16 degrees, 3 of 8.

    Returns:
        Fractions by the keys of `ACCURACIES`, and the median error in degrees.
    """
    device = network.device
    training = network.training
    network.eval()
    generator = np.random.default_rng(0)
    best_rotations = _regressed if network.preset.rotation == "regression" else _best_of_grid(network, level)
    i, j = (index.tolist() for index in np.triu_indices(views, 1))
    errors, angles = [], []
    for _ in range(count):
        batch = make_batch(scans, 1, views, 180.0, generator)
        features = scene_features(network, _looks(batch, device), batch.crop_parameters.to(device))
        best = best_rotations(network, features, i, j)
        rotation = batch.camera_from_world[0, :, :, :3]
        true = rotation[j] @ rotation[i].swapaxes(-1, -2)
        errors.append(np.degrees(so3.angle_between(best, true)))
        angles.append(np.degrees(so3.angle_between(true, np.eye(3))))
    network.train(training)
    error, angle = np.concatenate(errors), np.concatenate(angles)
    figures = {
        "pair@15": float((error <= 15).mean()),
        "pair@30": float((error <= 30).mean()),
        "pair_median": float(np.median(error)),
        "identity@15": float((angle <= 15).mean()),
    }
    for low, high in BINS:
        inside = (angle >= low) & (angle < high)
        correct = float((error[inside] <= 15).mean()) if inside.any() else float("nan")
        figures[f"pair@15_{low:g}-{high:g}"] = correct
    return figures


def _best_of_grid(network: RelPose, level: int) -> BestRotations:
    rotations = np.array(so3_grid.grid(level))
    embeddings = network.embed_relative(torch.from_numpy(rotations).float().to(network.device))

    def best(network: RelPose, features: SceneFeatures, i: list[int], j: list[int]) -> FloatArray:
        energies = network.pair_energies(network.pair_contexts(features, i, j), embeddings)[0]
        return np.asarray(rotations[energies.argmax(-1).cpu().numpy()])

    return best


def _regressed(network: RelPose, features: SceneFeatures, i: list[int], j: list[int]) -> FloatArray:
    rotations = network.optical_rotations(features)[0].double().cpu().numpy()
    return np.asarray(rotations[j] @ rotations[i].swapaxes(-1, -2))


def save_pieces(state: State, folder: Path, piece_bytes: int = PIECE_BYTES) -> None:
    """Write a checkpoint as files of limited size; the listing, written last, makes it the current one."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    content = buffer.getvalue()
    digest = hashlib.sha256(content).hexdigest()
    names = []
    for number, start in enumerate(range(0, len(content), piece_bytes)):
        names.append(f"checkpoint-{digest[:12]}.{number:03d}")
        (folder / names[-1]).write_bytes(content[start : start + piece_bytes])
    listing = folder / "checkpoint.json"
    partial = listing.with_suffix(".partial")
    partial.write_text(json.dumps({"pieces": names, "sha256": digest}) + "\n", encoding="utf-8")
    os.replace(partial, listing)  # noqa: PTH105 - a rename within one folder is all or nothing
    for old in folder.glob("checkpoint-*.[0-9][0-9][0-9]"):
        if old.name not in names:
            old.unlink()


def load_pieces(folder: Path) -> State:
    """Read what `save_pieces` wrote.

    Raises:
        TrainingError: A piece is missing or damaged.
    """
    try:
        listing = json.loads((folder / "checkpoint.json").read_text(encoding="utf-8"))
        content = b"".join((folder / name).read_bytes() for name in listing["pieces"])
    except (OSError, ValueError, KeyError) as err:
        text = f"the checkpoint in {folder} cannot be read: {err}."
        raise TrainingError(text) from err
    if hashlib.sha256(content).hexdigest() != listing["sha256"]:
        text = f"the checkpoint in {folder} is damaged: its pieces do not have the digest in checkpoint.json."
        raise TrainingError(text)
    state: State = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    return state


def _own_device(device: str) -> torch.device:
    own = torch.device(device)
    if own.type == "cuda" and own.index is None and "LOCAL_RANK" in os.environ:
        own = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
    return own


def _join(device: torch.device) -> tuple[int, int]:
    """Rank and number of processes; joins those that torchrun started."""
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    if processes > 1 and not distributed.is_initialized():
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return (distributed.get_rank(), processes) if processes > 1 else (0, 1)


def _looks(batch: Batch, device: torch.device) -> Looks:
    if isinstance(batch.looks, torch.Tensor):
        return batch.looks.to(device)
    return [None if each is None else each.to(device) for each in batch.looks]


def _moved(targets: Targets, device: torch.device) -> Targets:
    return replace(
        targets,
        true=targets.true.to(device),
        uniform=targets.uniform.to(device),
        near=targets.near.to(device),
        log_density=targets.log_density.to(device),
        rotations=targets.rotations.to(device),
        translations=targets.translations.to(device),
        places=None if targets.places is None else targets.places.to(device),
        asked=None if targets.asked is None else targets.asked.to(device),
    )


def _cut_curve(path: Path, step: int) -> None:
    """Forget what was logged after the checkpoint: those steps are taken again."""
    if path.exists():
        with path.open(newline="", encoding="utf-8") as stream:
            header, *rows = list(csv.reader(stream))
        with path.open("w", newline="", encoding="utf-8") as stream:
            csv.writer(stream).writerows([header, *(row for row in rows if int(row[0]) <= step)])
