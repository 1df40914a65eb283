"""The command line as a user meets it: exit codes, and sentences where something is wrong."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from relpose_ros import cli
from relpose_ros.captures.folder import Frame, save_capture
from relpose_ros.geometry.cameras import look_at, translation_of
from relpose_ros.network.checkpoint import load_network, random_network, read_metadata, write_network
from relpose_ros.network.presets import PRESETS, named_preset
from relpose_ros.training.batches import open_scans
from relpose_ros.views import BoundingBox, Intrinsics, View

COMMANDS = (
    *("node", "replay", "pack", "evaluate", "calibrate"),
    *("render", "shard", "features", "train", "convert"),
)


@pytest.fixture
def posed_capture(tmp_path):
    """Three noisy pictures with poses around a point."""
    random = np.random.default_rng(0)
    frames = []
    for azimuth in (0.0, 0.4, 0.9):
        centre = np.array([np.sin(azimuth), -np.cos(azimuth), 0.3])
        rotation = look_at(centre, np.zeros(3))
        view = View(
            image=random.integers(0, 256, (96, 128, 3), dtype=np.uint8),
            box=BoundingBox(30, 20, 90, 80),
            full_width=128,
            full_height=96,
            intrinsics=Intrinsics(120.0, 120.0, 64.0, 48.0),
        )
        pose = np.column_stack([rotation, translation_of(rotation, centre)])
        frames.append(Frame(view, pose))
    return save_capture(tmp_path / "capture", frames).folder


@pytest.fixture
def random_weights(tmp_path):
    """A weights file of a network that learned nothing."""
    file = tmp_path / "random.safetensors"
    # With a backbone that the parameter `precision` means something to.
    preset = replace(PRESETS["compact"], backbone="residual", stage_depths=(1, 1, 1, 1))
    write_network(random_network(preset, 0), file, {"source": "random, for a test"})
    return file


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main([command, "--help"])
    assert end.value.code == 0
    assert command in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["replay", "missing_bag", "--output", "out"], "missing_bag"),
        (["pack", "missing_capture", "--output", "bag"], "missing_capture"),
        (["evaluate", "missing_capture"], "missing_capture"),
        (["convert", "missing.pth", "--output", "out.safetensors"], "missing.pth"),
        (["train", "run", "--scans", "missing_shards"], "shard"),
    ],
)
def test_what_is_missing_is_named_in_one_sentence(arguments, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == 1
    printed = capsys.readouterr().err.strip()
    assert printed.startswith(f"relpose_ros {arguments[0]}: ")
    assert named in printed
    assert len(printed.splitlines()) == 1
    assert "Traceback" not in printed


@pytest.mark.parametrize("text", ["", "two", "5..2", "2..", "3.5", "9", "1..8"])
def test_numbers_of_views_that_are_none(text, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["evaluate", "capture", "--views", text])
    assert end.value.code == 2
    assert "numbers of views from 2 to 8" in capsys.readouterr().err


def test_numbers_of_views():
    arguments = cli._parser().parse_args(["evaluate", "capture", "--views", "3..5"])
    assert arguments.views == (3, 4, 5)
    assert cli._parser().parse_args(["evaluate", "capture", "--views", "4"]).views == (4,)


def test_the_weights_may_lie_in_the_home_folder(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    arguments = cli._parser().parse_args(["evaluate", "capture", "--weights=~/mine.safetensors"])
    assert arguments.weights == tmp_path / "mine.safetensors"
    with pytest.raises(SystemExit) as end:
        cli.main(["evaluate", "capture", "--weights=~no body/mine.safetensors"])
    assert end.value.code == 2
    assert "'~no body/mine.safetensors' begins with the home folder of a user" in capsys.readouterr().err


def test_a_missing_extra_is_named(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "moderngl", None)
    for name in [each for each in sys.modules if each.startswith("relpose_ros.captures.render")]:
        monkeypatch.delitem(sys.modules, name)
    assert cli.main(["render", str(tmp_path)]) == 1
    assert "pip install 'relpose_ros[train]'" in capsys.readouterr().err


def test_a_defect_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr(cli, "_convert", lambda arguments: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        cli.main(["convert", "a", "--output", "b"])


def test_ctrl_c_is_no_defect(monkeypatch):
    def interrupted(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_convert", interrupted)
    assert cli.main(["convert", "a", "--output", "b"]) == 130


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, cli.SPINS),
        ({"GOMP_SPINCOUNT": "7"}, "7"),
        ({"OMP_WAIT_POLICY": "active"}, None),
    ],
)
def test_threads_wait_briefly_unless_the_user_says_otherwise(given, expected, tmp_path):
    """Before PyTorch is imported, whose threads read it once."""
    code = (
        "import os, sys\n"
        "from relpose_ros import cli\n"
        "assert 'torch' not in sys.modules\n"
        "cli.main(['convert', 'missing.pth', '--output', 'out'])\n"
        "assert 'torch' in sys.modules\n"
        "print(os.environ.get('GOMP_SPINCOUNT'))\n"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=True, env={**environment, **given}
    )
    assert done.stdout.strip() == str(expected)


def test_the_commands_need_no_ros(tmp_path):
    """Only `node` does: a laptop without ROS replays bags."""
    code = (
        "import sys\n"
        "sys.modules['rclpy'] = None\n"
        "from relpose_ros import cli\n"
        "sys.exit(cli.main(['replay', 'missing_bag', '--output', 'out']))\n"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "missing_bag does not exist" in done.stderr


def test_a_capture_becomes_a_bag_an_estimate_and_a_row(tmp_path, posed_capture, random_weights, monkeypatch):
    """The main road from end to end, on a tiny capture and a network that knows nothing."""
    bag, out, rows = tmp_path / "bag", tmp_path / "out", tmp_path / "rows.json"
    assert cli.main(["pack", str(posed_capture), "--output", str(bag)]) == 0
    assert cli.main(["replay", str(bag), "--output", str(out), "--weights", str(random_weights)]) == 0
    scan = json.loads((out / "scan.json").read_text())
    assert [len(estimate["views"]) for estimate in scan["estimates"]] == [2, 3]
    assert (out / "report.html").stat().st_size > 10_000

    parameters = tmp_path / "parameters.yaml"
    parameters.write_text("/**:\n  ros__parameters:\n    weights: ~/random.safetensors\n")
    monkeypatch.setenv("HOME", str(random_weights.parent))
    again = tmp_path / "again"
    assert cli.main(["replay", str(bag), "--output", str(again), "--config", str(parameters)]) == 0
    assert (again / "scan.json").read_bytes() == (out / "scan.json").read_bytes()

    parameters.write_text(parameters.read_text() + "    precision: bfloat16\n")
    assert cli.main(["replay", str(bag), "--output", str(again), "--config", str(parameters)]) == 0
    assert (again / "scan.json").read_bytes() != (out / "scan.json").read_bytes()

    evaluate = ["evaluate", str(posed_capture), "--views", "2..3", "--orders", "1", "--output", str(rows)]
    assert (
        cli.main([*evaluate, "--method", "relpose", "--method", "identity", "--weights", str(random_weights)])
        == 0
    )
    of_capture = json.loads(rows.read_text())["rows"]
    assert {row["method"] for row in of_capture} == {"relpose", "identity"}

    # The bag holds the same pictures and poses; the random orders go by the name.
    evaluate[1] = str(bag.rename(tmp_path / posed_capture.name / "bag"))
    assert cli.main([*evaluate, "--method", "identity"]) == 0
    of_bag = json.loads(rows.read_text())["rows"]
    assert [(row["capture"], row["views"]) for row in of_bag] == [
        *(("bag", 2), ("bag", 3), ("mean", 2), ("mean", 3))
    ]
    whole = ("rotation@median", "center@auc0.4")  # at N = 3 every order holds all three
    assert [of_bag[1][key] for key in whole] == pytest.approx(
        [next(r for r in of_capture if (r["method"], r["views"]) == ("identity", 3))[key] for key in whole],
        abs=1e-4,
    )


def test_captures_of_one_name_are_told_apart(tmp_path, posed_capture):
    for day in ("monday", "tuesday"):
        shutil.copytree(posed_capture, tmp_path / day / "mug")
    shutil.copytree(posed_capture, tmp_path / "bowl")
    rows = tmp_path / "rows.json"
    mugs = [str(tmp_path / day / "mug") for day in ("monday", "tuesday")]
    command = ["evaluate", "--views", "2", "--method", "identity", "--output", str(rows)]
    assert cli.main([*command, *mugs, str(tmp_path / "bowl")]) == 0
    together = {row["capture"]: row for row in json.loads(rows.read_text())["rows"]}
    assert list(together) == [*(f"{mug}: mug" for mug in mugs), "bowl", "mean"]
    assert cli.main([*command, mugs[0]]) == 0
    alone = json.loads(rows.read_text())["rows"][0]
    for row in (alone, together[f"{mugs[0]}: mug"]):
        del row["capture"], row["seconds"]
    assert alone == together[f"{mugs[0]}: mug"]


def test_a_capture_named_twice_is_refused(posed_capture, capsys):
    capture = str(posed_capture)
    assert cli.main(["evaluate", "--views", "2", "--method", "identity", capture, capture]) == 1
    assert f"two captures are called {capture}: capture" in capsys.readouterr().err


def test_weights_are_calibrated_on_captures_and_bags(tmp_path, posed_capture, random_weights, capsys):
    bag, output = tmp_path / "bag", tmp_path / "calibrated.safetensors"
    assert cli.main(["pack", str(posed_capture), "--output", str(bag)]) == 0
    command = ["calibrate", str(random_weights), str(posed_capture), str(bag), "--output", str(output)]
    assert cli.main([*command, "--scans", "1", "--half"]) == 0
    assert "calibration" in read_metadata(output)
    assert output.stat().st_size < 0.6 * random_weights.stat().st_size
    assert 'calibration error of "within 15 degrees"' in capsys.readouterr().out


def test_captures_become_shards(tmp_path, posed_capture):
    shards = tmp_path / "shards"
    assert cli.main(["shard", str(posed_capture.parent), "--output", str(shards), "--copies", "2"]) == 0
    assert len(open_scans([shards])) == 2
    features = tmp_path / "features"
    assert cli.main(["features", str(shards), "--output", str(features), "--plain"]) == 0
    kept = open_scans([features])
    assert len(kept) == 2
    # What the network that ships would see of its crops.
    network = load_network()
    wanted = network.feature_extractor.summarised_shapes
    assert {stage: kept.map_shapes[stage] for stage in wanted} == wanted


def test_variants_masks_and_categories_of_co3d(tmp_path, write_category, capsys):
    """A network that regresses, beside the others, on a dataset in its published format."""
    write_category(tmp_path / "co3d", "kite", ["7_8_9"], frames=3)
    write_category(tmp_path / "co3d", "cup", ["1_2_3"], frames=3)
    weights, rows = tmp_path / "regression.safetensors", tmp_path / "rows.json"
    write_network(random_network(named_preset("compact", ["regression"]), 0), weights)
    command = ["evaluate", str(tmp_path / "co3d"), "--views", "2", "--orders", "1", "--output", str(rows)]
    command += ["--method", "identity", "--variant", str(weights), "--no-masks"]
    for split, name in (("held_out", "7_8_9"), ("train", "1_2_3")):
        assert cli.main([*command, "--split", split]) == 0
        found = [(row["capture"], row["method"]) for row in json.loads(rows.read_text())["rows"]]
        assert found[:2] == [(name, "identity"), (name, "regression")]
    printed = capsys.readouterr().out
    assert "What estimates said of their own errors" in printed
    assert len([line for line in printed.splitlines() if line.startswith("mean  ")]) == 6
