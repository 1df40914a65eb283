"""What all tests share."""

from __future__ import annotations

import gzip
import json
import os
import random
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest

from relpose_ros import cli

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fisher_scenes import FisherScene

SHARED = Path(__file__).resolve().parents[2] / "shared"
"""Material that does not belong in the repository; a fresh clone elsewhere has none."""

# Before torch is imported: more threads than cores make small tensors slower, not faster.
os.environ.setdefault("OMP_NUM_THREADS", "1" if "PYTEST_XDIST_WORKER" in os.environ else "2")
os.environ.setdefault("GOMP_SPINCOUNT", cli.SPINS)

# The same examples each time, and no deadline: how loaded a machine is must not decide whether a test passes.
hypothesis.settings.register_profile("relpose_ros", deadline=None, derandomize=True, database=None)
hypothesis.settings.load_profile("relpose_ros")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of shared material; skips the test where there is none."""
    if not SHARED.is_dir():
        pytest.skip(f"there is no folder {SHARED.name}/ beside the checkout")
    return SHARED


@pytest.fixture
def ros_environment(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """A ROS graph of the test's own on this machine: set for this process, returned for those it starts.

    The whole environment goes with it: ROS wheels start the interpreter anew where they do not find what they
    put there before.
    """
    monkeypatch.setenv("ROS_DOMAIN_ID", str(random.SystemRandom().randint(1, 101)))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.delenv("ROS_STATIC_PEERS", raising=False)
    return dict(os.environ)


@pytest.fixture
def write_category() -> Callable[..., None]:
    """Writes a tiny category of CO3Dv2: dataset folder, name, names of sequences."""
    return _write_category


def _write_category(root: Path, category: str, sequences: Sequence[str], *, frames: int = 2) -> None:
    """A category of CO3Dv2 in its published format, with as little in it as will do."""
    import cv2
    import numpy as np

    annotations = []
    (root / category).mkdir(parents=True)
    for sequence in sequences:
        for k in range(frames):
            files = {kind: f"{category}/{sequence}/{kind}s/{k}.png" for kind in ("image", "mask")}
            for file in files.values():
                (root / file).parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(root / file), np.full((20, 30), 255, np.uint8))
            viewpoint = {
                "R": np.eye(3).tolist(), "T": [0.0, 0.0, 2.0 + k], "intrinsics_format": "ndc_isotropic",
                "focal_length": [2.0, 2.0], "principal_point": [0.0, 0.0],
            }  # fmt: skip
            annotations.append(
                {
                    "sequence_name": sequence,
                    "frame_number": k,
                    "image": {"path": files["image"], "size": [20, 30]},
                    "mask": {"path": files["mask"]},
                    "viewpoint": viewpoint,
                }
            )
    listed = [{"sequence_name": sequence, "viewpoint_quality_score": 1.0} for sequence in sequences]
    for name, content in (("frame", annotations), ("sequence", listed)):
        with gzip.open(root / category / f"{name}_annotations.jgz", "wt") as stream:
            json.dump(content, stream)


@pytest.fixture(scope="session")
def fisher_scene_type() -> tuple[type[FisherScene], object]:
    """Scenes of known energies, and cameras to put into them."""
    import fisher_scenes

    return fisher_scenes.FisherScene, fisher_scenes.around_object
