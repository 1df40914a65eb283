"""Build backend: setuptools, asking for the ROS generators only where no ROS 2 is at hand.

A sourced ROS 2 builds the messages for itself: wheels of another one beside it would clash.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ros_prefix import sourced_prefixes
from setuptools import build_meta
from setuptools.build_meta import (
    build_editable,
    build_sdist,
    build_wheel,
    get_requires_for_build_sdist,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    Settings = Mapping[str, str | list[str] | None] | None

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]


def get_requires_for_build_wheel(config_settings: Settings = None) -> list[str]:
    """What to install before a wheel can be built."""
    return build_meta.get_requires_for_build_wheel(config_settings) + requirements()


def get_requires_for_build_editable(config_settings: Settings = None) -> list[str]:
    """What to install before an editable wheel can be built."""
    return build_meta.get_requires_for_build_editable(config_settings) + requirements()


def requirements() -> list[str]:
    """The lines of requirements.txt, without ROS where a sourced one generates the messages."""
    lines = (Path(__file__).parent / "requirements.txt").read_text(encoding="utf-8").splitlines()
    wanted = [line for line in lines if line and not line.startswith("#")]
    return [line for line in wanted if not (line.startswith("ros-") and sourced_prefixes())]
