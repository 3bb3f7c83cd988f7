"""The parameter tree on a ROS node: declaration, overrides from files and command line, changes at run time."""

from __future__ import annotations

from collections.abc import Callable

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from eskf_ros.parameters.mapping import Leaf, from_mapping, leaves, to_mapping
from eskf_ros.parameters.ros_yaml import profile_values
from eskf_ros.parameters.schema import Value
from eskf_ros.parameters.tree import Parameters


def declare(node: Node, source: str = "", profile: str = "") -> Parameters:
    """Declare every parameter on the node; return the values from parameter files and the command line.

    A ``profile`` gives those that neither has.

    The overrides are checked as a whole before anything is declared, by the same rules as `--config` of the replay.
    `source` names them in errors (default: the node). Raises ParameterError listing every unknown key (with the closest
    known one), wrong type and value outside its range.
    """
    known = {leaf.name: leaf for leaf in leaves()}
    given = profile_values(profile) if profile else {}
    given |= {name: _given(parameter, known.get(name)) for name, parameter in _overrides(node).items()}
    parameters = from_mapping(given, source or f"parameters of {node.get_fully_qualified_name()}")
    for name, value in to_mapping(parameters).items():
        node.declare_parameter(name, _ros_value(value), _descriptor(known[name]), ignore_override=True)
    return parameters


def unused_overrides(node: Node) -> list[str]:
    """Return the given names that belong to nothing on this node, such as `qos_overrides.` of a missing topic.

    To be called when all publishers and subscriptions exist: they declare the overrides of their quality of service.
    """
    return sorted(name for name in _overrides(node) if not node.has_parameter(name))


def _overrides(node: Node) -> dict[str, Parameter]:
    # rclpy offers no public access that leaves parameters without a value (`datum: []`) intact: declaring them all
    # automatically fails there. The attribute has been in every release since 2019, and rclpy itself declares from it.
    overrides: dict[str, Parameter] = node._parameter_overrides
    return overrides


def _given(parameter: Parameter, leaf: Leaf | None) -> object:
    # rcl takes the type of a list from its elements, so an empty one arrives as a parameter without a value.
    if parameter.value is None and leaf is not None and 0 in leaf.rule.lengths:
        return ()
    value: object = parameter.value
    return value


def _ros_value(value: Value) -> object:
    return list(value) if isinstance(value, tuple) else value


def _descriptor(leaf: Leaf) -> ParameterDescriptor:
    rule = leaf.rule
    unit = f" [{rule.unit}]" if rule.unit else ""
    default = _ros_value(leaf.default)
    descriptor = ParameterDescriptor(
        name=leaf.name,
        description=f"{rule.description}{unit} Default {default}.",
        additional_constraints=leaf.allowed(),
        read_only=not rule.live,
        # rclpy cannot tell what type of list an empty one is.
        dynamic_typing=0 in rule.lengths,
    )
    minimum = rule.minimum if rule.above is None else rule.above
    maximum = rule.maximum if rule.below is None else rule.below
    if leaf.kind == "integer":
        descriptor.integer_range = [IntegerRange(from_value=minimum, to_value=maximum, step=0)]
    # rclpy applies ranges to single numbers only, and finds NaN outside of every range.
    if leaf.kind == "float" and not rule.nan_allowed and isinstance(minimum, float) and isinstance(maximum, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=minimum, to_value=maximum, step=0.0)]
    return descriptor


class LiveParameters:
    """Watches the parameters of a node: refuses what is not allowed, and reports what has changed.

    `current` always holds the values in force.
    """

    def __init__(self, node: Node, current: Parameters, on_change: Callable[[Parameters], None]) -> None:
        """Watch the parameters that `declare` has returned.

        `on_change` gets the whole tree after each accepted change; several parameters that are set atomically are one
        change.
        """
        self.current = current
        self._on_change = on_change
        self._known = {leaf.name: leaf for leaf in leaves()}
        node.add_pre_set_parameters_callback(self._with_floats)
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._apply)

    def _with_floats(self, changes: list[Parameter]) -> list[Parameter]:
        """Turn integers into floats where a float is expected: people write 2 for 2.0, which rclpy would refuse."""
        return [self._with_float(change) for change in changes]

    def _with_float(self, change: Parameter) -> Parameter:
        leaf = self._known.get(change.name)
        kind = leaf.kind if leaf is not None else ""
        if change.type_ == Parameter.Type.INTEGER and kind == "float":
            return Parameter(change.name, value=float(change.value))
        if change.type_ == Parameter.Type.INTEGER_ARRAY and kind == "float list":
            return Parameter(change.name, value=[float(number) for number in change.value])
        return change

    def _judge(self, changes: list[Parameter]) -> SetParametersResult:
        for change in changes:
            leaf = self._known.get(change.name)
            if leaf is not None:
                try:
                    leaf.convert(change.value)
                except ValueError as error:
                    return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, changes: list[Parameter]) -> None:
        changed = {change.name: change.value for change in changes if change.name in self._known}
        if changed:
            self.current = from_mapping({**to_mapping(self.current), **changed})
            self._on_change(self.current)
