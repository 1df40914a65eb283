"""The settings of a scan as ROS parameters: declared with descriptors, read back, and judged when set."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException

from relpose_ros.scanning.settings import ScanSettings, SettingsError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from dataclasses import Field

    from rclpy.node import Node
    from rclpy.parameter import Parameter

NAMES = tuple(each.name for each in fields(ScanSettings))
ONLY_UNCONFIGURED = frozenset(each.name for each in fields(ScanSettings) if each.metadata["fixed"]) | {
    "weights",
    "precision",
    "threads",
}
"""Read when the node is configured: setting one of them later would silently do nothing."""
BACK, FORTH = ("deactivate", "cleanup"), ("configure", "activate")
"""Transitions from an active node to one that can be configured, and from there to an active one."""
OF_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides./clock.")
"""How the names begin that rclpy declares in every node."""


def declare_parameters(node: Node) -> ScanSettings:
    """Declare one parameter per setting, and read the values given on the command line or in a file.

    Raises:
        SettingsError: A given value has the wrong type or lies outside its range.
    """
    values = {}
    for each in fields(ScanSettings):
        try:
            node.declare_parameter(each.name, _as_parameter(each.default), _descriptor(each))
            values[each.name] = node.get_parameter(each.name).value
        except ParameterException as err:
            raise SettingsError(f"The value given for {each.name} is refused: {err}.") from err
    return ScanSettings.from_mapping(values)


def unknown_parameters(given: Iterable[str], overridable: Iterable[str]) -> list[str]:
    """A sentence about each name that was given a value and that the node does not have.

    ROS passes over such a name without a word.

    Args:
        given: Names given on the command line or in a file.
        overridable: The ``qos_overrides`` of the node's topics.
    """
    known = (*NAMES, *overridable)
    return [
        f"There is no parameter {name}{did_you_mean(name, known)}: the value given for it does nothing."
        for name in given
        if name not in known and not name.startswith(OF_RCLPY)
    ]


def changed_settings(
    settings: ScanSettings, parameters: Sequence[Parameter], *, configured: str = ""
) -> ScanSettings:
    """The settings with some parameters set anew. Parameters that are none of ours are passed over.

    Args:
        settings: The settings in force.
        parameters: What somebody wants to set.
        configured: The node's name, where it is past its configuration.

    Raises:
        SettingsError: A value is refused, or comes too late.
    """
    current = {name: getattr(settings, name) for name in NAMES}
    wanted = {each.name: each.value for each in parameters if each.name in NAMES}
    for name, value in wanted.items():
        if value is None:
            raise SettingsError(f"{name} cannot be unset: give it a value.")
        # `ros2 param load` sets all parameters of a file, most of them to what they are.
        if not configured or value == _as_parameter(current[name]):
            continue
        if name == "autostart":
            raise SettingsError("autostart is read when the node starts: give it there.")
        if name in ONLY_UNCONFIGURED:
            text = f"{name} is read when the node is configured. First {lifecycle(configured, *BACK)}; then"
            raise SettingsError(f"{text} set it, and {lifecycle(configured, *FORTH)}.")
    return ScanSettings.from_mapping(current | wanted)


def lifecycle(node_name: str, *transitions: str) -> str:
    """The commands that take a node through some transitions."""
    return ", ".join(f"`ros2 lifecycle set {node_name} {each}`" for each in transitions)


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
