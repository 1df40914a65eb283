from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import pytest
import yaml

from relpose_ros.scanning.settings import ScanSettings, SettingsError

CONFIG = Path(__file__).resolve().parents[2] / "config" / "relpose_ros.yaml"


def test_the_shipped_file_states_every_default() -> None:
    written = yaml.safe_load(CONFIG.read_text())["/**"]["ros__parameters"]
    assert list(written) == [each.name for each in fields(ScanSettings)]
    assert ScanSettings.from_yaml(CONFIG) == ScanSettings()


def test_the_shipped_file_gives_a_reason_for_every_key() -> None:
    lines = CONFIG.read_text().splitlines()
    for each in fields(ScanSettings):
        (line,) = [k for k, text in enumerate(lines) if text.strip().startswith(f"{each.name}:")]
        assert lines[line - 1].strip().startswith("# "), each.name


def test_every_setting_describes_itself() -> None:
    for each in fields(ScanSettings):
        assert each.metadata["description"].endswith("."), each.name
        numeric = type(each.default) in {int, float}
        assert (each.metadata["range"] is not None) == numeric, each.name


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("max_views", 1, "max_views is 1: it must lie between 2 and 8"),
        ("max_views", 9, "between 2 and 8"),
        ("max_views", True, "must be of type int"),
        ("max_views", 3.0, "must be of type int"),
        ("keep", "best", "must be one of first, latest, spread"),
        ("object_frame", "", "1 to 128 printable characters"),
        ("object_frame", "a\nb", "printable"),
        ("object_id", "x" * 129, "printable"),
        ("backward_jump_s", float("nan"), "must lie between"),
        ("backward_jump_s", 0.0, "must lie between"),
        ("image_transports", ("raw", "theora"), "'theora'"),
        ("image_transports", (), "name raw, compressed or both"),
        ("threads", -1, "between 0 and 256"),
        ("weights", None, "must be of type str"),
    ],
)
def test_what_no_scanner_could_work_with_is_refused(name: str, value: object, said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        replace(ScanSettings(), **{name: value})


def test_a_mapping_may_spell_values_as_parameters_do() -> None:
    settings = ScanSettings.from_mapping({"backward_jump_s": 2, "image_transports": ["raw"]})
    assert settings == ScanSettings(backward_jump_s=2.0, image_transports=("raw",))
    with pytest.raises(SettingsError, match=r"no setting max_view \(did you mean max_views\?\): the"):
        ScanSettings.from_mapping({"max_view": 3})
    with pytest.raises(SettingsError, match="no setting zzz: the settings are object_frame"):
        ScanSettings.from_mapping({"zzz": 3})


def test_a_parameter_file_may_hold_several_nodes(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_text(
        "/**:\n  ros__parameters: {max_views: 3, use_sim_time: true}\n"
        "camera:\n  ros__parameters: {exposure: 1}\n"
        "/scan_node:\n  ros__parameters: {qos_overrides./image.subscription.depth: 9}\n"
        "scan_node:\n  ros__parameters: {max_views: 4}\n"
    )
    assert ScanSettings.from_yaml(path) == ScanSettings(max_views=4)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("max_views: 3\n", "holds no parameters of the scan node"),
        ("", "holds no parameters"),
        ("/**: {max_views: 3}\n", "has no ros__parameters"),
        ("/**: [\n", "cannot be read"),
        ("/**:\n  ros__parameters: {max_views: many}\n", "max_views is 'many'"),
    ],
)
def test_a_wrong_parameter_file_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "params.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=said):
        ScanSettings.from_yaml(path)


def test_a_missing_parameter_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="cannot be read"):
        ScanSettings.from_yaml(tmp_path / "absent.yaml")


def test_the_weights_may_lie_in_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert ScanSettings().weights_path is None
    assert ScanSettings(weights="~/mine.safetensors").weights_path == tmp_path / "mine.safetensors"
    assert ScanSettings(weights="/a/~b").weights_path == Path("/a/~b")
    with pytest.raises(SettingsError, match="'~no body/w': it begins with the home folder of a user"):
        _ = ScanSettings(weights="~no body/w").weights_path
