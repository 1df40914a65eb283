"""The ready RViz layout, and the files that the launch file names, against what the node publishes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from relpose_ros.replay import replay
from relpose_ros.scanning.settings import ScanSettings

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def rviz() -> dict[str, Any]:
    text = (ROOT / "config" / "relpose_ros.rviz").read_text(encoding="utf-8")
    manager: dict[str, Any] = yaml.safe_load(text)["Visualization Manager"]
    return manager


def test_rviz_shows_the_nodes_topics_in_the_object_frame(rviz: dict[str, Any]) -> None:
    node = pytest.importorskip("relpose_ros.node.topics", reason="ROS 2 is not installed")
    published = {
        name.replace("~", "/scan_node"): message_type.__name__ for name, message_type in node.OUTPUTS
    }
    displays = [each for each in rviz["Displays"] if "Topic" in each]
    assert {each["Class"].rpartition("/")[2] for each in displays} == {"MarkerArray", "PoseArray"}
    for each in displays:
        topic = each["Topic"]
        assert published[topic["Value"]] == each["Class"].rpartition("/")[2]
        offered = node.RESULT_QOS
        assert topic["Durability Policy"].replace(" ", "_").upper() == offered.durability.name
        assert topic["Reliability Policy"].upper() == offered.reliability.name
    assert rviz["Global Options"]["Fixed Frame"] == ScanSettings().object_frame
    replayed = {replay.ESTIMATE_TOPIC, replay.POSES_TOPIC, replay.MARKERS_TOPIC}
    assert replayed == set(published), "one layout is for both"


def test_the_launch_file_names_files_that_are_there() -> None:
    text = (ROOT / "launch" / "scan_node.launch.py").read_text(encoding="utf-8")
    named = re.findall(r'config / "([^"]+)"', text)
    assert sorted(named) == ["relpose_ros.rviz", "relpose_ros.yaml"]
    for each in named:
        assert (ROOT / "config" / each).is_file()
