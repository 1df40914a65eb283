"""The messages as they are installed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from ament_index_python import get_package_prefix
from rclpy.serialization import deserialize_message, serialize_message

from relpose_ros import msg
from relpose_ros.estimates import Evidence, Verdict

ROOT = Path(__file__).resolve().parents[2]
NAMES = sorted(path.stem for path in (ROOT / "msg").glob("*.msg"))


@pytest.mark.parametrize("name", NAMES)
def test_every_definition_is_built(name: str) -> None:
    message = getattr(msg, name)()
    data = serialize_message(message)
    assert deserialize_message(data, type(message)) == message


@pytest.fixture(scope="module")
def prefix() -> Path:
    with pytest.MonkeyPatch.context() as patch:
        known = os.environ.get("AMENT_PREFIX_PATH")
        patch.setenv("AMENT_PREFIX_PATH", os.pathsep.join(filter(None, [known, sys.prefix])))
        return Path(get_package_prefix("relpose_ros"))


@pytest.mark.parametrize("path", ["package.xml", *(f"msg/{name}.msg" for name in NAMES)])
def test_the_ament_index_leads_to_what_is_in_the_repository(prefix: Path, path: str) -> None:
    installed = prefix / "share" / "relpose_ros" / path
    assert installed.read_bytes() == (ROOT / path).read_bytes()


def test_the_executables_are_installed(prefix: Path) -> None:
    for executable in ("bin/relpose_ros", "lib/relpose_ros/scan_node"):
        assert os.access(prefix / executable, os.X_OK), executable


def test_the_node_gets_the_arguments_as_they_were_given(tmp_path: Path) -> None:
    program = tmp_path / "bin" / "relpose_ros"
    script = tmp_path / "lib" / "relpose_ros" / "scan_node"
    for path in (program, script):
        path.parent.mkdir(parents=True)
    program.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n', encoding="utf-8")
    script.write_bytes((ROOT / "build_support" / "scan_node").read_bytes())
    for path in (program, script):
        path.chmod(0o755)
    arguments = ["--ros-args", "-p", "object_frame:=a cup", "-r", "__node:=scanner"]
    told = subprocess.run([script, *arguments], check=True, capture_output=True, text=True, cwd="/").stdout
    assert told.splitlines() == ["node", *arguments]


@pytest.mark.parametrize("verdict", list(Verdict))
def test_verdicts_have_the_values_of_the_message(verdict: Verdict) -> None:
    assert getattr(msg.ScanEstimate, f"VERDICT_{verdict.name}") == verdict


@pytest.mark.parametrize("evidence", list(Evidence))
def test_evidence_has_the_values_of_the_message(evidence: Evidence) -> None:
    assert getattr(msg.PairUncertainty, f"EVIDENCE_{evidence.name}") == evidence
