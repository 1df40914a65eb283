"""The core runs where there is no ROS: a training machine, a notebook."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

# Every installed distribution but torch, NumPy and what these two require themselves cannot be imported.
IMPORT_ALL = """
import importlib, importlib.metadata as metadata, pkgutil, re, sys

def with_requirements(name, known):
    name = re.sub("[-_.]+", "-", name).lower()
    if name in known:
        return known
    try:
        requires = metadata.requires(name) or []
    except metadata.PackageNotFoundError:
        return known
    known.add(name)
    for requirement in requires:
        if "extra ==" not in requirement:
            with_requirements(re.match("[A-Za-z0-9._-]+", requirement).group(), known)
    return known

allowed = with_requirements("torch", with_requirements("numpy", set()))
provided = metadata.packages_distributions()
blocked = {
    module
    for module, owners in provided.items()
    if not any(re.sub("[-_.]+", "-", owner).lower() in allowed for owner in owners)
} - {"relpose_ros"}
assert {"rclpy", "sensor_msgs", "cv2", "rosbags", "yaml"} <= blocked, sorted(blocked)

class Blocker:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] in blocked or name.startswith("relpose_ros.msg"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocker)
for package in sys.argv[1:]:
    module = importlib.import_module(package)
    for found in pkgutil.walk_packages(module.__path__, package + "."):
        importlib.import_module(found.name)
    print(package)
"""


@pytest.fixture(scope="module")
def imported() -> subprocess.CompletedProcess[str]:
    packages = [f"relpose_ros.{name}" for name in ("geometry", "network", "inference")]
    command = [sys.executable, "-c", IMPORT_ALL, *packages]
    return subprocess.run(
        command, cwd=ROOT, env=dict(os.environ), capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.parametrize("package", ["geometry", "network", "inference"])
def test_the_core_imports_with_torch_and_numpy_alone(
    package: str, imported: subprocess.CompletedProcess[str]
) -> None:
    assert f"relpose_ros.{package}" in imported.stdout.split(), imported.stderr
