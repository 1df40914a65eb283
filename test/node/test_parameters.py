from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

import pytest
import rclpy
from rclpy.parameter import Parameter

from relpose_ros.node.parameters import ONLY_UNCONFIGURED, changed_settings, declare_parameters
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
    assert changed_settings(ScanSettings(), others, configured=True) == ScanSettings()


def test_several_parameters_change_together() -> None:
    wanted = [Parameter("max_views", value=5), Parameter("keep", value="latest")]
    changed = changed_settings(ScanSettings(max_scans=2), wanted, configured=True)
    assert changed == ScanSettings(max_scans=2, max_views=5, keep="latest")


@pytest.mark.parametrize("name", sorted(ONLY_UNCONFIGURED))
def test_what_is_read_once_changes_only_before(name: str) -> None:
    default = SETTINGS[name].default
    wanted = [Parameter(name, value=list(default) if isinstance(default, tuple) else default)]
    assert changed_settings(ScanSettings(), wanted, configured=False) == ScanSettings()
    with pytest.raises(SettingsError, match=f"{name} .*configure"):
        changed_settings(ScanSettings(), wanted, configured=True)


def test_a_parameter_cannot_be_unset() -> None:
    with pytest.raises(SettingsError, match="max_views"):
        changed_settings(ScanSettings(), [Parameter("max_views")], configured=False)
