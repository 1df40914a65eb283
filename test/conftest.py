"""What all tests share."""

from __future__ import annotations

import os
import random
from pathlib import Path

import hypothesis
import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"
"""Material that does not belong in the repository; a fresh clone elsewhere has none."""

# Before torch is imported: more threads than cores make small tensors slower, not faster.
os.environ.setdefault("OMP_NUM_THREADS", "2")

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
