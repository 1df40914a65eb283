"""What each step of a run sees: a function of seed, step, images seen before, and the process's rank.

So a resumed run sees what it would have seen, and batches may be drawn by processes beside the trainer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from torch.utils.data import Dataset

from relpose_ros.training.batches import Scans, make_batch
from relpose_ros.training.objective import Batch, Targets, make_targets

if TYPE_CHECKING:
    from collections.abc import Iterator

    from relpose_ros.training.settings import TrainingSettings


@dataclass(frozen=True)
class StepPlan:
    """What a step needs to be drawn, wherever that happens."""

    step: int
    views: int
    max_angle: float


class StepPlans:
    """The plans of all steps from one on. Every process has the same, so that none waits for another."""

    def __init__(self, settings: TrainingSettings, step: int, images: int, processes: int) -> None:
        self._settings, self._step, self._images, self._processes = settings, step, images, processes

    def __iter__(self) -> Iterator[StepPlan]:
        settings, step, images = self._settings, self._step, self._images
        while images < settings.images:
            generator = np.random.default_rng([settings.seed, step])
            views = int(generator.integers(settings.min_views, settings.max_views + 1))
            # Near views go on being practised when far ones have begun.
            angle = float(generator.uniform(settings.curriculum[0][1], settings.max_angle(images)))
            yield StepPlan(step, views, angle)
            images += settings.scans_of(views) * views * self._processes
            step += 1


class Steps(Dataset[tuple[Batch, Targets]]):
    """Batch and targets of a planned step: a function of the plan, the seed and the rank alone."""

    def __init__(self, settings: TrainingSettings, scans: Scans, rank: int) -> None:
        self._settings, self._scans, self._rank = settings, scans, rank

    def __getitem__(self, plan: StepPlan) -> tuple[Batch, Targets]:
        settings = self._settings
        generator = np.random.default_rng([settings.seed, plan.step, self._rank])
        batch = make_batch(
            self._scans,
            settings.scans_of(plan.views),
            plan.views,
            plan.max_angle,
            generator,
            settings.augmentation,
        )
        frame = settings.network.translation_frame
        return batch, make_targets(batch, settings.objective, generator, translation_frame=frame)
