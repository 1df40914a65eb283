"""What the files that describe the package say about one another."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def build_requirements() -> list[str]:
    lines = (ROOT / "build_support" / "requirements.txt").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def test_the_version_is_the_same_everywhere(project: dict[str, Any]) -> None:
    version = project["project"]["version"]
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    releases = re.findall(r"^(\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8"), re.M)
    assert manifest.findtext("version") == version
    assert releases[0] == version
    assert metadata.version("relpose_ros") == version


def test_the_backend_builds_with_the_setuptools_it_was_started_with(
    project: dict[str, Any], build_requirements: list[str]
) -> None:
    assert project["build-system"]["requires"] == [
        r for r in build_requirements if r.startswith("setuptools")
    ]


def test_messages_are_built_against_the_ros_that_the_extra_installs(
    project: dict[str, Any], build_requirements: list[str]
) -> None:
    pins = dict(line.split("==") for line in project["project"]["optional-dependencies"]["ros"])
    built = dict(line.split("==") for line in build_requirements if line.startswith("ros-"))
    for package in ("ros-geometry-msgs", "ros-sensor-msgs", "ros-std-msgs"):
        assert built[package] == pins["ros-common-interfaces"]


def test_a_sourced_ros_keeps_the_wheels_of_another_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, build_requirements: list[str]
) -> None:
    monkeypatch.syspath_prepend(ROOT / "build_support")
    backend = importlib.import_module("backend")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    assert backend.requirements() == build_requirements, "a prefix without generators builds no messages"
    manifest = tmp_path / "share" / "rosidl_default_generators" / "package.xml"
    manifest.parent.mkdir(parents=True)
    manifest.touch()
    assert backend.requirements() == [line for line in build_requirements if not line.startswith("ros-")]


def test_the_build_knows_every_message() -> None:
    listed = re.findall(r"^  msg/(\w+)\.msg$", (ROOT / "CMakeLists.txt").read_text(encoding="utf-8"), re.M)
    assert sorted(listed) == sorted(path.stem for path in (ROOT / "msg").glob("*.msg"))


def test_no_file_names_a_place_on_somebodys_machine() -> None:
    try:
        names = subprocess.run(
            ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this is no git checkout")
    place = re.compile(rb"(?<![\w.])/(?:home|root|Users|work)/\w")
    named = []
    for name in filter(None, names.split("\0")):
        path = ROOT / name
        content = path.read_bytes() if path.is_file() else b""
        if b"\0" not in content[:8192] and place.search(content):
            named.append(name)
    assert named == []


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "relpose_ros/weights/MODEL_CARD.md"])
def test_a_page_links_to_what_is_there(page: str) -> None:
    links = re.findall(r"\]\(([^)#]+)\)", (ROOT / page).read_text(encoding="utf-8"))
    local = [link for link in links if "://" not in link]
    missing = [link for link in local if not (ROOT / page).parent.joinpath(link).exists()]
    assert missing == []
