"""How a network is trained, and what a run begins with."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from relpose_ros.errors import RelPoseError
from relpose_ros.network.checkpoint import random_network
from relpose_ros.network.presets import Preset, named_preset
from relpose_ros.training.batches import Augmentation
from relpose_ros.training.imagenet import imagenet_backbone
from relpose_ros.training.objective import ObjectiveSettings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from relpose_ros.network.relpose import RelPose


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

    def __post_init__(self) -> None:
        """Refuse a rate that would climb the loss.

        Raises:
            TrainingError: The backbone's rate is negative or no number.
        """
        if not 0 <= self.backbone_rate < math.inf:
            text = f"the backbone's rate is {self.backbone_rate}; give 0 to leave it as it is, or more."
            raise TrainingError(text)

    @property
    def network(self) -> Preset:
        """The preset with its variants."""
        return named_preset(self.preset, self.variants)

    @property
    def pretrained_backbone(self) -> bool:
        """Whether the backbone begins with the weights of `relpose_ros.training.imagenet`."""
        return self.network.backbone == "efficientnet_lite0"

    def scans_of(self, views: int) -> int:
        """Scans of so many views in a process's step."""
        return max(1, self.batch_images // views)

    def max_angle(self, images: int) -> float:
        """How far views may be turned from the one they surround when so many images were seen, degrees."""
        share = images / self.images
        return max((start, angle) for start, angle in self.curriculum if start <= share)[1]


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
