"""The settings of a scan as ROS parameters: declared with descriptors, read back, and judged when set."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException

from relpose_ros.scanning.settings import ScanSettings, SettingsError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from dataclasses import Field

    from rclpy.node import Node
    from rclpy.parameter import Parameter

NAMES = tuple(each.name for each in fields(ScanSettings))
ONLY_UNCONFIGURED = frozenset(each.name for each in fields(ScanSettings) if each.metadata["fixed"]) | {
    "weights",
    "threads",
}
"""Read when the node is configured: setting one of them later would silently do nothing."""


def declare_parameters(node: Node) -> ScanSettings:
    """Declare one parameter per setting, and read the values given on the command line or in a file.

    Raises:
        SettingsError: A given value has the wrong type or lies outside its range.
    """
    for each in fields(ScanSettings):
        try:
            node.declare_parameter(each.name, _as_parameter(each.default), _descriptor(each))
        except ParameterException as err:
            raise SettingsError(f"The value given for {each.name} is refused: {err}.") from err
    return ScanSettings.from_mapping({name: node.get_parameter(name).value for name in NAMES})


def changed_settings(
    settings: ScanSettings, parameters: Sequence[Parameter], *, configured: bool
) -> ScanSettings:
    """The settings with some parameters set anew. Parameters that are none of ours are passed over.

    Args:
        settings: The settings in force.
        parameters: What somebody wants to set.
        configured: Whether the node is past its configuration.

    Raises:
        SettingsError: A value is refused, or comes too late.
    """
    wanted = {each.name: each.value for each in parameters if each.name in NAMES}
    for name, value in wanted.items():
        if value is None:
            raise SettingsError(f"{name} cannot be unset: give it a value.")
        if configured and name in ONLY_UNCONFIGURED:
            text = "is read when the node is configured: clean the node up, set it, and configure again."
            raise SettingsError(f"{name} {text}")
    current = {name: getattr(settings, name) for name in NAMES}
    return ScanSettings.from_mapping(current | wanted)


def _as_parameter(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _descriptor(setting: Field[Any]) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=setting.metadata["description"])
    choices, limits = setting.metadata["choices"], setting.metadata["range"]
    constraints = []
    if choices is not None:
        several = isinstance(setting.default, tuple)
        constraints.append(f"{'some' if several else 'one'} of: {', '.join(choices)}")
    if setting.name in ONLY_UNCONFIGURED:
        constraints.append("to be set before the node is configured")
    descriptor.additional_constraints = "; ".join(constraints)
    if limits is not None and isinstance(setting.default, int):
        descriptor.integer_range = [IntegerRange(from_value=int(limits[0]), to_value=int(limits[1]), step=1)]
    elif limits is not None:
        span = FloatingPointRange(from_value=float(limits[0]), to_value=float(limits[1]))
        descriptor.floating_point_range = [span]
    return descriptor
