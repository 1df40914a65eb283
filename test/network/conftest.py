"""The published network with the weights of the golden recipe, made once: it takes seconds and 550 MB."""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from relpose_ros.network.checkpoint import load_network, random_network

if TYPE_CHECKING:
    from pathlib import Path

    from relpose_ros.network.features import SceneFeatures
    from relpose_ros.network.relpose import RelPose


@dataclass(frozen=True)
class Golden:
    network: RelPose
    images: torch.Tensor
    crop_parameters: torch.Tensor
    rotations: torch.Tensor
    features: SceneFeatures
    expected: dict[str, np.ndarray]
    solver: dict[str, np.ndarray]
    names: dict[str, dict[str, object]]


def recipe_weights(
    names: dict[str, dict[str, object]], own: dict[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    weights = dict(own)
    for name, entry in names.items():
        if not entry["filled_by_recipe"]:
            continue
        shape = entry["shape"]
        n = np.random.Generator(np.random.PCG64(zlib.crc32(name.encode()))).standard_normal(shape)
        if not name.endswith("weight"):
            n = 0.1 * n
        elif len(shape) > 1:
            n = n * np.sqrt(2 / np.prod(shape[1:]))
        else:
            n = 1 + 0.1 * n
        weights[name] = torch.from_numpy(n.astype(np.float32))
    return weights


def recipe_inputs(seed: int, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    g = np.random.Generator(np.random.PCG64(seed))
    images = g.standard_normal((1, count, 3, 224, 224)).astype(np.float32)[0]
    crops = (g.uniform(-1, 1, (1, count, 3)) * [0.5, 0.5, 0.6] + [0, 0, 1.1]).astype(np.float32)[0]
    q = g.standard_normal((1000, 4))
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32).T
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    rotations = np.stack(rows, 1).reshape(-1, 3, 3)
    return torch.from_numpy(images), torch.from_numpy(crops), torch.from_numpy(rotations)


@pytest.fixture(scope="session")
def golden(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Golden:
    folder = shared / "golden"
    names = json.loads((folder / "state_dict.json").read_text())
    released = recipe_weights(names, random_network("paper", 0).state_dict())
    file = tmp_path_factory.mktemp("golden") / "ckpt.pth"
    torch.save({"state_dict": {f"module.{name}": tensor for name, tensor in released.items()}}, file)
    network = load_network(file)
    file.unlink()
    images, crop_parameters, rotations = recipe_inputs(7, 4)
    with torch.no_grad():
        features = network.encode(images, crop_parameters)
    return Golden(
        network,
        images,
        crop_parameters,
        rotations,
        features,
        dict(np.load(folder / "network_n4.npz")),
        dict(np.load(folder / "solver_n4.npz")),
        names,
    )


@pytest.fixture(scope="session")
def compact() -> RelPose:
    return random_network("compact", 1)
