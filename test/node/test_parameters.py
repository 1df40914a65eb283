from __future__ import annotations

import re
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import pytest
import rclpy
from rclpy.parameter import Parameter

from relpose_ros.node.parameters import (
    ONLY_UNCONFIGURED,
    changed_settings,
    declare_parameters,
    unknown_parameters,
)
from relpose_ros.scanning.settings import ScanSettings, SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

SETTINGS = {each.name: each for each in fields(ScanSettings)}


@pytest.fixture(scope="module")
def make_node(domain: int) -> Iterator[Callable[..., Any]]:
    """Makes nodes whose parameters were given values."""
    context = rclpy.Context()
    context.init(domain_id=domain)
    nodes = []

    def make(**given: Any) -> Any:
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        nodes.append(
            rclpy.create_node("settings", context=context, parameter_overrides=overrides, enable_rosout=False)
        )
        return nodes[-1]

    yield make
    for each in nodes:
        each.destroy_node()
    context.shutdown()


def test_every_setting_becomes_a_parameter_with_its_default_and_limits(
    make_node: Callable[..., Any],
) -> None:
    node = make_node()
    assert declare_parameters(node) == ScanSettings()
    for name, setting in SETTINGS.items():
        descriptor = node.describe_parameter(name)
        assert descriptor.description == setting.metadata["description"]
        for choice in setting.metadata["choices"] or ():
            assert choice in descriptor.additional_constraints
        if setting.metadata["range"] is not None:
            ((span,),) = (
                each for each in (descriptor.integer_range, descriptor.floating_point_range) if each
            )
            assert (span.from_value, span.to_value) == setting.metadata["range"]


def test_given_values_count(make_node: Callable[..., Any]) -> None:
    settings = declare_parameters(make_node(max_views=3, keep="first", image_transports=["raw"]))
    assert settings == ScanSettings(max_views=3, keep="first", image_transports=("raw",))


@pytest.mark.parametrize(
    ("name", "value"), [("max_views", 1), ("max_views", "all"), ("keep", "none"), ("image_transports", [])]
)
def test_given_values_that_are_refused(make_node: Callable[..., Any], name: str, value: Any) -> None:
    with pytest.raises(SettingsError, match=name):
        declare_parameters(make_node(**{name: value}))


def test_parameters_of_others_are_passed_over() -> None:
    others = [Parameter("use_sim_time", value=True), Parameter("qos_overrides./image.depth", value=3)]
    assert changed_settings(ScanSettings(), others, configured="/scan_node") == ScanSettings()


def test_several_parameters_change_together() -> None:
    wanted = [Parameter("max_views", value=5), Parameter("keep", value="latest")]
    changed = changed_settings(ScanSettings(max_scans=2), wanted, configured="/scan_node")
    assert changed == ScanSettings(max_scans=2, max_views=5, keep="latest")


OTHER_VALUES = {
    "weights": "mine.safetensors",
    "precision": "bfloat16",
    "threads": 3,
    "image_transports": ["raw"],
    "autostart": False,
}


@pytest.mark.parametrize("name", sorted(ONLY_UNCONFIGURED - {"autostart"}))
def test_what_is_read_once_changes_only_before(name: str) -> None:
    wanted = [Parameter(name, value=OTHER_VALUES[name])]
    assert changed_settings(ScanSettings(), wanted) != ScanSettings()
    with pytest.raises(SettingsError) as refused:
        changed_settings(ScanSettings(), wanted, configured="/lab/scan_node")
    commands = re.findall(r"`ros2 lifecycle set /lab/scan_node (\w+)`", str(refused.value))
    assert commands == ["deactivate", "cleanup", "configure", "activate"]
    assert str(refused.value).startswith(f"{name} ")


def test_autostart_is_over_once_the_node_is_configured() -> None:
    with pytest.raises(SettingsError, match="autostart is read when the node starts"):
        changed_settings(ScanSettings(), [Parameter("autostart", value=False)], configured="/scan_node")


def test_a_parameter_may_be_set_to_what_it_is() -> None:
    """As `ros2 param load` does with the shipped file."""
    same = [
        Parameter(name, value=list(each.default) if isinstance(each.default, tuple) else each.default)
        for name, each in SETTINGS.items()
    ]
    assert changed_settings(ScanSettings(), same, configured="/scan_node") == ScanSettings()
    assert set(OTHER_VALUES) == ONLY_UNCONFIGURED


QOS = "qos_overrides./image.subscription.reliability"


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("evidense", "evidence"),
        ("max_view", "max_views"),
        ("qos_overrides./imag.subscription.reliability", QOS),
        ("qos_overrides./image.subscription.reliabilty", QOS),
    ],
)
def test_a_misspelt_parameter_is_told_with_the_nearest_name(given: str, meant: str) -> None:
    (sentence,) = unknown_parameters(["keep", given, QOS], [QOS])
    assert f"no parameter {given} (did you mean {meant}?)" in sentence


def test_a_parameter_like_no_other_is_told_too() -> None:
    assert unknown_parameters(["zzz"], [QOS]) == [
        "There is no parameter zzz: the value given for it does nothing."
    ]


def test_the_parameters_of_rclpy_are_no_mistake() -> None:
    given = ["use_sim_time", "start_type_description_service", "qos_overrides./clock.subscription.depth"]
    assert unknown_parameters(given, [QOS]) == []


def test_a_parameter_cannot_be_unset() -> None:
    with pytest.raises(SettingsError, match="max_views"):
        changed_settings(ScanSettings(), [Parameter("max_views")])
