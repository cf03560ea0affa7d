"""Declaration of typed schemas as ROS parameters with type, description and range, and reading of their values."""

from __future__ import annotations

import difflib
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import wraps
from types import NoneType
from typing import Any, Literal, NamedTuple, Protocol, TypeVar, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterType,
    SetParametersResult,
)
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter

from diffdrive_mpc.models.checked_yaml import ConfigError, check
from diffdrive_mpc.models.plug_ins import plug_in, plug_in_names
from diffdrive_mpc.models.suggestions import suggestion
from diffdrive_mpc.models.two_sided import SIDES, TwoSided, side_fields
from diffdrive_mpc.mpc.config.feature_groups import is_disabled, is_feature
from diffdrive_mpc.mpc.config.fixed_values import fixed_values
from diffdrive_mpc.mpc.config.former_keys import current_place, removed_message
from diffdrive_mpc.mpc.config.rooms import EXPERT, plain_key, shown_key
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.ros.settings import FORMER_SETTINGS, REPLACED_SETTINGS, NodeSettings

Value = bool | int | float | str
Schema = TypeVar("Schema", bound=BaseModel)

_MAX_INTEGER = 2**63 - 1
NONE = 0.0
"""Parameter value that represents None, since a ROS parameter has a fixed type."""


class _Entry(NamedTuple):
    """Field of a schema, with its dotted key and its value; the value is None if there is no instance."""

    key: str
    field: FieldInfo
    value: object


def fields(config: BaseModel | type[BaseModel]) -> list[tuple[str, FieldInfo]]:
    """Return all fields that are parameters, by dotted key; lists are not parameters.

    Fields of a controller are sorted by section, see `mpc.config.rooms`. Groups of parts and features are included only
    if `config` is an instance.
    """
    return [(entry.key, entry.field) for entry in _entries(config)]


def _entries(config: BaseModel | type[BaseModel]) -> list[_Entry]:
    declared = list(_leaves(config))
    if ControllerConfig not in (config, type(config)):
        return declared
    renamed = [entry._replace(key=shown_key(entry.key)) for entry in declared]
    return sorted(renamed, key=lambda entry: entry.key.startswith(f"{EXPERT}."))


_PREFIXES = {"parts": "parts.", "features": ""}
"""Prefix of the keys of named groups, by the field that maps names to groups."""


def _leaves(config: BaseModel | type[BaseModel], prefix: str = "") -> Iterator[_Entry]:
    """Yield the fields of all groups with their plain keys; lists are omitted."""
    for name, field in (config if isinstance(config, type) else type(config)).model_fields.items():
        kind, value = field.annotation, None if isinstance(config, type) else getattr(config, name)
        if name in _PREFIXES:
            for group_name, group in (value or {}).items():
                yield from _leaves(group, f"{prefix}{_PREFIXES[name]}{group_name}.")
        elif isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from _leaves(kind if value is None else value, f"{prefix}{name}.")
        elif get_origin(kind) is not list:
            yield _Entry(prefix + name, field, value)
            sides = value.sides if isinstance(value, TwoSided) and not value.is_symmetric else (None, None)
            for (side, side_field), limit in zip(side_fields(name, field).items(), sides, strict=False):
                yield _Entry(prefix + side, side_field, limit)


def _list_fields(config: BaseModel | type[BaseModel], prefix: str = "") -> Iterator[tuple[str, object]]:
    """Yield the lists of an instance with their plain keys."""
    for name, value in config if isinstance(config, BaseModel) else ():
        groups = {name: value} if isinstance(value, BaseModel) else value if name in _PREFIXES else {}
        if isinstance(value, list):
            yield prefix + name, value
        for group_name, group in groups.items():
            yield from _list_fields(group, f"{prefix}{_PREFIXES.get(name, '')}{group_name}.")


def declare(node: Node, config: BaseModel, *, read_only: bool = False, skip: tuple[str, ...] = ()) -> None:
    """Declare all fields of `config` except the keys in `skip`, with the values of `config` as defaults.

    Raises
    ------
    rclpy.exceptions.ParameterException
        If an override from the command line or a parameter file has a wrong type or is out of range.
    """
    if isinstance(config, ControllerConfig):
        current_keys = {plain_key(key): key for key, _ in fields(config)}
        _rename_keys(node, lambda name: current_keys.get(plain_key(name), name))
    parameters = [
        (key, _to_parameter(value), descriptor(field, read_only=read_only))
        for key, field, value in _entries(config)
        if key not in skip
    ]
    overrides = _overrides(node)
    # Users write 1 instead of 1.0 in YAML and on the command line, which ROS would reject as a wrong type.
    for key, value, _ in parameters:
        if key in overrides and isinstance(value, float):
            overrides[key] = _as_real(overrides[key])
    node.declare_parameters("", parameters)


def _as_real(parameter: Parameter) -> Parameter:
    """Convert an integer parameter to a floating-point parameter; return other parameters unchanged."""
    if parameter.type_ is not Parameter.Type.INTEGER:
        return parameter
    return Parameter(parameter.name, value=float(parameter.value))


_DEFAULT_HINT = "; docs/parameters.md lists all of them"
_ROS_PREFIX = "qos_overrides."
"""Prefix of parameters that rclpy declares, some of them after `check_overrides`."""


def check_overrides(node: Node, config: ControllerConfig) -> None:
    """Check that all parameters of the command line and of files are declared; warn about parameters without effect.

    Raises
    ------
    models.checked_yaml.ConfigError
        If an unknown parameter resembles a parameter of the node; the message suggests that parameter. Other unknown
        parameters cause only a warning, since other nodes share the section `/**` of a file.
    """
    groups = {key.partition(".")[0] for key in node.list_parameters([], 0).names if "." in key}
    disabled: dict[str, list[str]] = {}
    for name, parameter in _overrides(node).items():
        group, _, key = plain_key(name).rpartition(".")
        switch = shown_key(f"{group}.enabled")
        if node.has_parameter(name):
            if node.has_parameter(switch) and not node.get_parameter(switch).value and key != "enabled":
                disabled.setdefault(switch, []).append(name)
        elif is_feature(group.partition(".")[0]) and group.partition(".")[0] not in config.features:
            disabled.setdefault(switch, []).append(name)
        elif not name.startswith(_ROS_PREFIX) and fixed_values().get(plain_key(name)) != parameter.value:
            message = unknown_parameter(node, config, name)
            if not message.endswith(_DEFAULT_HINT) or name.partition(".")[0] in groups:
                raise ConfigError(message)
            node.get_logger().warning(f"without effect: {message}")
    for switch, names in disabled.items():
        node.get_logger().warning(f"without effect while {switch} is false: {', '.join(names)}")


def unknown_parameter(node: Node, config: ControllerConfig, name: str) -> str:
    """Return the message about an undeclared parameter: a suggestion, or the new key or file of its value."""
    key = plain_key(name)
    if removed_message(key):
        return f"parameter {removed_message(key)}"
    place = current_place(name.removeprefix(f"{EXPERT}."))
    if key in fixed_values():
        return f"{name!r} is {place} now, with the value {fixed_values()[key]}; remove it"
    if key in dict(_list_fields(config)) or place:
        return f"{name!r} is not a parameter: set {place or shown_key(key)} in the file given by the parameter config"
    similar = difflib.get_close_matches(name, list(node.list_parameters([], 0).names), n=1, cutoff=0.75)
    if similar:
        return f"unknown parameter {name!r}; did you mean '{similar[0]}'?"
    hints = (suggestion(schema, key.split("."), shown_key) for schema in (ControllerConfig, NodeSettings))
    hint = next((hint for hint in hints if "did you mean" in hint), _DEFAULT_HINT)
    return f"unknown parameter {name!r}{hint}"


def with_features(node: Node, config: ControllerConfig) -> ControllerConfig:
    """Return `config` with an additional group for each feature that is only configured by parameters.

    Otherwise ROS would silently ignore the parameters of such a feature.

    Raises
    ------
    MissingPackageError
        If the parameters configure a feature that no installed package provides.
    """
    feature_values: dict[str, dict[str, object]] = {}
    for name, parameter in _overrides(node).items():
        feature, _, key = plain_key(name).partition(".")
        if key and feature not in (*ControllerConfig.model_fields, *config.features) and is_feature(feature):
            feature_values.setdefault(feature, {})[key] = parameter.value
    installed = plug_in_names("features")
    groups = {
        feature: plug_in("features", feature).schema()
        for feature, values in feature_values.items()
        if feature in installed or not is_disabled(values)
    }
    return config.model_copy(update={"features": {**config.features, **groups}})


def with_parts(node: Node, settings: NodeSettings, features: Iterable[str]) -> NodeSettings:
    """Return `settings` with an additional group for each part that parameters or features require.

    Raises
    ------
    ConfigError
        If a parameter was replaced by another parameter.
    MissingPackageError
        If no installed package provides a part in the parameters.
    """
    overrides = _overrides(node)
    for name, remedy in REPLACED_SETTINGS.items():
        if name in overrides:
            raise ConfigError(f"parameter {name} was removed: {remedy}")
    for name in FORMER_SETTINGS.keys() & overrides.keys():
        # A file of version 0.2.0 that contains the default must not require the package of the part.
        if overrides[name].value == FORMER_SETTINGS[name][1]:
            part = FORMER_SETTINGS[name][0]
            node.get_logger().warning(f"parameter {name} is parts.{part}.{name} now; the default is used")
            del overrides[name]
    _rename_keys(node, lambda name: f"parts.{FORMER_SETTINGS[name][0]}.{name}" if name in FORMER_SETTINGS else name)
    part_names = [name.split(".")[1] for name in overrides if name.startswith("parts.")]
    installed = plug_in_names("node_parts")
    part_names += [name for name in features if name in installed]
    groups = {name: plug_in("node_parts", name).schema() for name in dict.fromkeys(part_names)}
    return settings.model_copy(update={"parts": {**groups, **settings.parts}})


def _overrides(node: Node) -> dict[str, Parameter]:
    """Return the parameters of the command line and of parameter files, which rclpy 7.1 does not expose publicly."""
    overrides: dict[str, Parameter] = getattr(node, "_parameter_overrides", {})
    return overrides


def _rename_keys(node: Node, current_name: Callable[[str], str]) -> None:
    """Rename overrides that have a former name or are in the wrong section, with a warning for each.

    ROS silently ignores undeclared parameters, so a limit under its former name would otherwise have no effect.
    """
    overrides = _overrides(node)
    for name, parameter in list(overrides.items()):
        key = current_name(name)
        if key == name:
            continue
        is_renamed = key not in overrides
        if is_renamed:
            overrides[key] = Parameter(key, parameter.type_, parameter.value)
        del overrides[name]
        outcome = "the value is used" if is_renamed else "the value is ignored, since both are set"
        node.get_logger().warning(f"parameter {name} is {key} now; {outcome}")


def descriptor(field: FieldInfo, *, read_only: bool = False) -> ParameterDescriptor:
    """Build the descriptor of a field with its range; exclusive bounds are additional constraints in words."""
    bounds = [bound for bound in _metadata(field) if isinstance(bound, Gt | Ge | Lt | Le)]
    low: Any = next((b.gt if isinstance(b, Gt) else b.ge for b in bounds if isinstance(b, Gt | Ge)), None)
    high: Any = next((b.lt if isinstance(b, Lt) else b.le for b in bounds if isinstance(b, Lt | Le)), None)
    constraints = [f"greater than {b.gt}" for b in bounds if isinstance(b, Gt)]
    constraints += [f"less than {b.lt}" for b in bounds if isinstance(b, Lt)]
    if get_origin(field.annotation) is Literal:
        constraints.append(f"one of {', '.join(get_args(field.annotation))}")
    if _is_optional(field):
        constraints, low = [*constraints, f"{NONE:g}: none"], NONE
    result = ParameterDescriptor(
        description=field.description or "", additional_constraints=", ".join(constraints), read_only=read_only
    )
    if low is None and high is None:
        return result
    if _value_type(field) is int:
        result.integer_range = [
            IntegerRange(
                from_value=-_MAX_INTEGER if low is None else int(low),
                to_value=_MAX_INTEGER if high is None else int(high),
            )
        ]
    else:
        maximum = sys.float_info.max
        result.floating_point_range = [
            FloatingPointRange(
                from_value=-maximum if low is None else float(low), to_value=maximum if high is None else float(high)
            )
        ]
    return result


def read(node: Node, config: Schema | type[Schema], changes: Mapping[str, object] | None = None) -> Schema:
    """Return the declared parameters as a validated instance; `changes` override their values.

    The fields of `config` determine the parameters; lists, which are not parameters, are copied from `config`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If a value does not fit the schema.
    """
    values = dict(_list_fields(config))
    for key, field in fields(config):
        value = (changes or {})[key] if key in (changes or {}) else node.get_parameter(key).value
        values[plain_key(key)] = None if _is_optional(field) and value == NONE else value
    data: dict[str, Any] = {}
    for key, value in values.items():
        if value is None and key.rpartition(".")[2] in SIDES:
            continue
        *groups, name = key.split(".")
        level = data
        for group in groups:
            if isinstance(level.get(group), float):
                # A two-sided limit: the common value of both sides was stored first, and a side replaces it.
                level[group] = dict.fromkeys(SIDES[name], level[group])
            level = level.setdefault(group, {})
        level[name] = value
    schema = config if isinstance(config, type) else type(config)
    return check(schema, data, "parameters", shown_key if schema is ControllerConfig else str)


def _to_parameter(value: object) -> Value:
    if value is None:
        return NONE
    assert isinstance(value, bool | int | float | str)
    return float(value) if isinstance(value, TwoSided) else value


def _value_type(field: FieldInfo) -> type:
    """Return the type of the field's values; for an optional field, the type other than None."""
    kinds = [kind for kind in get_args(field.annotation) or (field.annotation,) if kind is not NoneType]
    inner = get_args(kinds[0])
    return inner[0] if inner else kinds[0]


def _is_optional(field: FieldInfo) -> bool:
    return NoneType in get_args(field.annotation)


def _metadata(field: FieldInfo) -> Iterator[object]:
    """Yield the bounds of the field, including those in its type annotation."""
    yield from field.metadata
    for kind in get_args(field.annotation):
        for item in getattr(kind, "__metadata__", ()):
            yield from item.metadata if isinstance(item, FieldInfo) else (item,)


# Prefixes of parameters that can change while the robot drives.
_CHANGEABLE_PREFIXES = ("weights.", "limits.")


class ParameterChanges:
    """Callbacks that validate and apply changes of declared parameters; other parameters are not checked.

    Parameters
    ----------
    node
        Node with the parameters.
    settings, config
        Declared settings and configuration.
    active_controller
        Function that returns the active controller; None while the node is not active.
    on_change
        Function that is called after a change of weights or limits of the active controller.

    Attributes
    ----------
    pending
        True if values have changed since the attribute was last set to False.
    """

    def __init__(
        self,
        node: Node,
        settings: NodeSettings,
        config: ControllerConfig,
        active_controller: Callable[[], Controller | None],
        on_change: Callable[[], None],
    ) -> None:
        self._node, self._settings, self._config = node, settings, config
        self._active_controller, self._on_change = active_controller, on_change
        self._known = {name for part in (settings, config) for name, _ in fields(part)} | {"use_sim_time"}
        self.pending = False
        node.add_pre_set_parameters_callback(self._prepare)
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)

    def _prepare(self, parameters: list[Parameter]) -> list[Parameter]:
        """Convert integers to floating-point numbers; raise an error with a suggestion for an undeclared parameter."""
        for parameter in parameters:
            if not self._node.has_parameter(parameter.name):
                error = ParameterNotDeclaredException([])
                error.args = (unknown_parameter(self._node, self._config, parameter.name),)
                raise error
        types = {item.name: self._node.describe_parameter(item.name).type for item in parameters}
        real = ParameterType.PARAMETER_DOUBLE
        return [_as_real(item) if types[item.name] == real else item for item in parameters]

    def _validate(self, parameters: list[Parameter]) -> SetParametersResult:
        changes = self._select_declared(parameters)
        fixed = [name for name, value in changes.items() if self._requires_inactive_node(name, value)]
        if fixed:
            reason = f"{fixed[0]} cannot change while the node is active; pause, deactivate, set it, activate"
            return SetParametersResult(successful=False, reason=reason)
        try:
            read(self._node, self._settings, changes)
            config = read(self._node, self._config, changes)
            # Only the construction of a controller detects some errors, such as a horizon within the dead time.
            if any(not plain_key(name).startswith(_CHANGEABLE_PREFIXES) for name in changes):
                Controller(config)
            controller = self._active_controller()
            if controller is not None:
                # The change must be possible while driving, since `_apply` cannot reject it.
                controller.updated(*_groups(changes, config))
        except (ValueError, OSError) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _requires_inactive_node(self, name: str, value: object) -> bool:
        if self._active_controller() is None or plain_key(name).startswith(_CHANGEABLE_PREFIXES):
            return False
        return bool(self._node.get_parameter(name).value != value)

    def _apply(self, parameters: list[Parameter]) -> None:
        """Apply changes between two ticks while active; otherwise they take effect at the next activation."""
        changes = self._select_declared(parameters)
        self.pending = self.pending or bool(changes)
        controller = self._active_controller()
        if controller is not None and changes:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                controller.update(*_groups(changes, read(self._node, self._config)))
            for warning in caught:
                self._node.get_logger().warning(str(warning.message))
            self._on_change()

    def _select_declared(self, parameters: Iterable[Parameter]) -> dict[str, Any]:
        return {item.name: item.value for item in parameters if item.name in self._known}


def _groups(changes: Mapping[str, Any], config: ControllerConfig) -> list[dict[str, float]]:
    """Return the changed weights and the changed limits with their values in `config`."""
    return [
        {
            name: getattr(getattr(config, prefix[:-1]), name)
            # A change of one side of a limit replaces the limit of both sides.
            for name in (key.split(".")[1] for key in map(plain_key, changes) if key.startswith(prefix))
        }
        for prefix in _CHANGEABLE_PREFIXES
    ]


class ManagedNode(Protocol):
    """Lifecycle node that stores the reason for its last failed transition."""

    failure: str

    def get_logger(self) -> RcutilsLogger:
        """Return the logger of the node."""
        ...


NodeType = TypeVar("NodeType", bound=ManagedNode)
Transition = Callable[[NodeType, LifecycleState], TransitionCallbackReturn]


def log_failures(transition: Transition[NodeType]) -> Transition[NodeType]:
    """Wrap a transition so that it logs exceptions; it returns FAILURE for ValueError and OSError, else ERROR."""

    @wraps(transition)
    def run(self: NodeType, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(self, state)
        except (ValueError, OSError) as error:
            self.failure = str(error)
            self.get_logger().error(self.failure)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.failure = f"{type(error).__name__}: {error}"
            self.get_logger().fatal(self.failure)
            return TransitionCallbackReturn.ERROR

    return run


def reject_forbidden_transitions(node: LifecycleNode) -> None:
    """Replace the callback of the service change_state, so that it rejects forbidden transitions with a warning.

    For such a transition, the callback of rclpy raises an error, which ends `spin` and the process.
    """
    services = {service.srv_type: service for service in node.services}
    change = services[ChangeState].callback

    def handle(request: Any, response: Any) -> Any:  # noqa: ANN401 - ROS messages have no types to check
        target, state = request.transition, services[GetState].callback(None, GetState.Response()).current_state
        # Two services have this type: one returns the transitions of the current state, the other all transitions.
        graph = services[GetAvailableTransitions].callback(None, GetAvailableTransitions.Response())
        allowed = [row.transition for row in graph.available_transitions if row.start_state.id == state.id]
        # As in rclpy, the label takes precedence over the number.
        if any(target.label == entry.label if target.label else target.id == entry.id for entry in allowed):
            return change(request, response)
        requested = f"'{target.label}'" if target.label else str(target.id)
        choice = ", ".join(f"{entry.label} ({entry.id})" for entry in allowed) or "none"
        node.get_logger().warning(f"transition {requested} refused: the node is {state.label}; allowed: {choice}")
        response.success = False
        return response

    services[ChangeState].callback = handle
