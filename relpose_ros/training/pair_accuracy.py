"""How often single pairs are right: to watch a run, not to compare methods with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from relpose_ros.geometry import so3, so3_grid
from relpose_ros.training.batches import Scans, make_batch
from relpose_ros.training.objective import scene_features

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from relpose_ros.network.features import SceneFeatures
    from relpose_ros.network.relpose import RelPose

    FloatArray = npt.NDArray[np.float64]
    BestRotations = Callable[[RelPose, SceneFeatures, list[int], list[int]], FloatArray]
    """(P, 3, 3) camera_j_from_camera_i of the pairs of one scan."""

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
        features = scene_features(network, batch.looks_on(device), batch.crop_parameters.to(device))
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
