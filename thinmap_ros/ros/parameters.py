"""Declaration of ROS parameters from the Config dataclasses of core, which hold the defaults."""

import dataclasses
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Generic

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from thinmap_ros.core.config import (
    SAFE_HIGHER,
    SAFE_LOWER,
    AnyConfig,
    check_safety,
    parameters_of,
    require_number,
    suggestion,
    with_values,
)
from thinmap_ros.core.errors import ConfigError, quoted
from thinmap_ros.ros.foreign import (
    foreign_values,
    given_files,
    is_known,
    overruled_values,
    translated,
)
from thinmap_ros.ros.private_rclpy import declared_names, given_parameters

STRICT = 'strict_parameters'
# What describes the robot: one file may give it to all nodes, also to those that do not need it.
ROBOT = (
    'robot_radius_m',
    'laser_pose',
    'zero_is_no_return',
    'max_range_m',
    'laser_range_noise_m',
    'scan_stamp',
    'max_tilt_rad',
    'body_sectors',
    'min_range_m',
    'scan_delay_s',
    'map_frame',
    'odom_frame',
    'odom_source',
    'base_frame',
    'scan_topic',
)

_RUN_TIME = {
    SAFE_LOWER: 'at run time at most the value at the start',
    SAFE_HIGHER: 'at run time at least the value at the start',
}


def declare_config(
    node: Node,
    config: type[AnyConfig],
    changed: Callable[[AnyConfig], None] | None = None,
    live: Collection[str] | None = None,
    base: AnyConfig | None = None,
) -> AnyConfig:
    """Declare each field of a config as a parameter of the node; return the config as it was set.

    base: where given, its values are the defaults.

    Parameters are read-only without `changed`. With it, those named in `live` (None: all) can be
    set at run time, and `changed` is called with the new config. A value that the config rejects is
    rejected with its reason; so is one that makes the robot less safe than at its start, as every
    peer on the graph may set parameters.
    Raises ConfigError where a value is outside its range or of the wrong type.
    """
    defaults = config() if base is None else base
    declared = list(parameters_of(defaults))
    names = {name for name, _, _ in declared}
    free = set() if changed is None else names if live is None else set(live)
    values = {}
    for name, field, default in declared:
        descriptor = _descriptor(field, read_only=name not in free)
        values[name] = _declared(node, name, default, descriptor)
    current = with_values(defaults, values)
    if changed is not None:
        _Changes(node, current, free, changed)
    return current


class _Changes(Generic[AnyConfig]):
    """Changes a config at run time: all values that are set together, or none."""

    def __init__(
        self, node: Node, current: AnyConfig, free: set[str], changed: Callable[[AnyConfig], None]
    ) -> None:
        self._node = node
        self._start = current
        self._current = current
        self._free = free
        self._changed = changed
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def _with(self, given: list[Parameter]) -> AnyConfig:
        values = {
            parameter.name: parameter.value for parameter in given if parameter.name in self._free
        }
        return with_values(self._current, values)

    def _check(self, given: list[Parameter]) -> SetParametersResult:
        try:
            check_safety(self._start, self._with(given))
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, given: list[Parameter]) -> None:
        new = self._with(given)
        if new != self._current:
            self._current = new
            changes = ', '.join(f'{p.name} = {p.value}' for p in given if p.name in self._free)
            self._node.get_logger().info(f'changed: {changes}')
            self._changed(new)


def declare_parameter(
    node: Node,
    name: str,
    default: Any,
    description: str,
    *,
    low: float | None = None,
    high: float | None = None,
) -> Any:
    """Declare a read-only parameter of the node, and return its value.

    low, high: inclusive bounds of a number.
    Raises ConfigError where the value is outside of them, not finite, or of the wrong type.
    """
    descriptor = ParameterDescriptor(description=description, read_only=True)
    value = _declared(node, name, default, descriptor)
    require_number(name, value, low, high)
    return value


def declare_texts(node: Node, name: str, default: str, description: str) -> tuple[str, ...]:
    """Declare a read-only parameter that is a text or a list of texts, and return them all.

    Raises ConfigError where it is neither, where a text is empty, or given twice.
    """
    descriptor = ParameterDescriptor(description=description, read_only=True, dynamic_typing=True)
    value = node.declare_parameter(name, default, descriptor).value
    texts = value if isinstance(value, list | tuple) else [value]
    are_texts = all(isinstance(each, str) and each for each in texts)
    if not texts or not are_texts or len(set(texts)) < len(texts):
        raise ConfigError(
            f'parameter {name} of node {node.get_name()}: {quoted(value)}: expected a text, or a '
            'list of different ones'
        )
    return tuple(texts)


def _declared(node: Node, name: str, default: Any, descriptor: ParameterDescriptor) -> Any:
    """Declare a parameter; return its value. Raises ConfigError where that is of a wrong type.

    An integer that was given for a float is that float, as in many parameter files.
    """
    overrides = given_parameters(node)
    given = overrides.get(name)
    is_float = isinstance(default, float)
    if is_float and given is not None and given.type_ == Parameter.Type.INTEGER:
        overrides[name] = Parameter(name, value=float(given.value))
    try:
        return node.declare_parameter(name, default, descriptor).value
    except Exception as error:
        # rclpy has an exception class for each kind of wrong value.
        raise ConfigError(f'parameter {name} of node {node.get_name()}: {error}') from error


def translate(node: Node, program: str) -> None:
    """Give a node what was given last, and its own parameters for those of other packages.

    program: name of the node before remapping. Sections of parameter files for the nodes that it
    replaces are read, too. Raises InputError where a parameter file is none.
    """
    given = given_parameters(node)
    for name, value in overruled_values(sys.argv, node.get_fully_qualified_name()).items():
        given[name] = Parameter(name, value=value)
    for file in given_files(sys.argv):
        for name, value in foreign_values(file, program, node.get_namespace()).items():
            if value is not None:
                given.setdefault(name, Parameter(name, value=value))
    if 'use_sim_time' in given:
        # Of a foreign section: the node has declared it before.
        node.set_parameters([given['use_sim_time']])
    own = translated(program, {name: parameter.value for name, parameter in given.items()})
    for name in given.keys() - own.keys():
        del given[name]
    for name in own.keys() - given.keys():
        given[name] = Parameter(name, value=own[name])


def given_text(node: Node, name: str, default: str) -> str:
    """Text that a node was given for a parameter that decides which others it declares.

    A value of another type is left to the declaration, which rejects it.
    """
    given = given_parameters(node).get(name)
    if given is None or given.type_ != Parameter.Type.STRING:
        return default
    return str(given.value)


def freeze_clock(node: Node) -> None:
    """Make `use_sim_time` of a node read-only.

    A node that is given another clock while it runs waits for times that do not come.
    """
    descriptor = ParameterDescriptor(
        type=Parameter.Type.BOOL.value,
        description='Use the time of /clock, of a simulation or a bag. Set it at the start.',
        read_only=True,
    )
    node.set_descriptor('use_sim_time', descriptor)


def declare_strict(node: Node) -> bool:
    """Declare the parameter `strict_parameters` and return its value."""
    return bool(
        declare_parameter(
            node,
            STRICT,
            False,
            'Refuse to start with a parameter that the node does not have. false: it is ignored '
            'with a warning, so that parameter files of other packages can be used.',
        )
    )


def declare_map_frame(node: Node) -> str:
    """Declare the parameter `map_frame` and return its value."""
    return str(declare_parameter(node, 'map_frame', 'map', 'Frame of the map (REP 105).'))


def declare_session(node: Node) -> str:
    """Declare the parameter `session_path` and return its value.

    Raises InputError where it names no session.
    """
    from thinmap_ros.files.sessions import require_session  # imports most of core

    path = str(
        declare_parameter(
            node,
            'session_path',
            '',
            'Path stem of the saved session to start from. Empty: start with an empty map.',
        )
    )
    if path:
        require_session(path)
    return path


def declare_recovery(node: Node) -> float:
    """Declare the parameter `recovery_timeout_s` and return its value."""
    return float(
        declare_parameter(
            node,
            'recovery_timeout_s',
            30.0,
            'Maximum age of a checkpoint that a restarted node resumes from (s). 0 disables '
            'recovery. Raise it where nodes restart slowly.',
            low=0.0,
        )
    )


def reject_unknown(node: Node, elsewhere: Mapping[str, str] | None = None) -> None:
    """Warn of parameters that were given and that the node does not have.

    elsewhere: as of `suggestion`, those that it has with another value of a parameter.

    With `strict_parameters`, and in nodes without it, they are an error. Parameters of the robot
    are accepted by every node, and so are those of other packages that another node takes. Where
    several nodes share a process, a parameter may be meant for another one: the last of them
    decides. Raises ConfigError.
    """
    shared = _SHARED.get() or _Shared()
    shared.names.append(node.get_name())
    shared.given |= {
        name
        for name in set(given_parameters(node)).difference(ROBOT)
        if not name.startswith('qos_overrides.') and not is_known(name)
    }
    shared.known |= {name for name in declared_names(node) if not name.startswith('qos_overrides')}
    shared.elsewhere |= elsewhere or {}
    known = shared.known
    unknown = sorted(shared.given - known)
    if len(shared.names) < shared.count or not unknown:
        return
    wrong = ', '.join(name + suggestion(name, known, shared.elsewhere) for name in unknown)
    nodes = ', '.join(shared.names)
    is_one = len(shared.names) == 1
    if node.has_parameter(STRICT) and not node.get_parameter(STRICT).value:
        lack = f'node {nodes} does not have' if is_one else f'nodes {nodes} do not have'
        node.get_logger().warning(
            f'ignored parameters that {lack}: {wrong}; {STRICT}: true makes them an error'
        )
        return
    lack = f'node {nodes} has' if is_one else f'nodes {nodes} have'
    has = 'it has' if is_one else 'they have'
    raise ConfigError(f'{lack} no parameter {wrong}; {has}: {", ".join(sorted(known))}')


@dataclasses.dataclass
class _Shared:
    """Parameters that the nodes of one process were given, and those that they declared."""

    count: int = 1
    names: list[str] = dataclasses.field(default_factory=list)
    given: set[str] = dataclasses.field(default_factory=set)
    known: set[str] = dataclasses.field(default_factory=set)
    elsewhere: dict[str, str] = dataclasses.field(default_factory=dict)


_SHARED: ContextVar[_Shared | None] = ContextVar('shared', default=None)


@contextmanager
def shared_process(count: int) -> Iterator[None]:
    """Let `count` nodes that are created inside share the parameters that they are given."""
    token = _SHARED.set(_Shared(count))
    try:
        yield
    finally:
        _SHARED.reset(token)


def _descriptor(field: 'dataclasses.Field[Any]', read_only: bool) -> ParameterDescriptor:
    keys = ('description', 'low', 'high', 'choices')
    description, low, high, choices = (field.metadata[k] for k in keys)
    descriptor = ParameterDescriptor(description=description, read_only=read_only)
    if choices is not None:
        descriptor.additional_constraints = 'one of: ' + ', '.join(choices)
    elif field.metadata['safe'] and not read_only:
        descriptor.additional_constraints = _RUN_TIME[field.metadata['safe']]
    if low is None or high is None or isinstance(field.default, bool):
        return descriptor
    if isinstance(field.default, int):
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    elif isinstance(field.default, float):
        allowed = FloatingPointRange(from_value=float(low), to_value=float(high))
        descriptor.floating_point_range = [allowed]
    return descriptor
