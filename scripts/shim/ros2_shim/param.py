"""`ros2 param`: parameters of running nodes."""

import sys
from argparse import ArgumentParser, Namespace
from typing import Any

import yaml
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.parameter import get_parameter_value

from ros2_shim.session import Session
from ros2_shim.verbs import ShimError, Verb, add_graph_arguments, say

_FIELDS = {
    ParameterType.PARAMETER_BOOL: ('Boolean value is:', 'bool_value'),
    ParameterType.PARAMETER_INTEGER: ('Integer value is:', 'integer_value'),
    ParameterType.PARAMETER_DOUBLE: ('Double value is:', 'double_value'),
    ParameterType.PARAMETER_STRING: ('String value is:', 'string_value'),
    ParameterType.PARAMETER_BYTE_ARRAY: ('Byte values are:', 'byte_array_value'),
    ParameterType.PARAMETER_BOOL_ARRAY: ('Boolean values are:', 'bool_array_value'),
    ParameterType.PARAMETER_INTEGER_ARRAY: ('Integer values are:', 'integer_array_value'),
    ParameterType.PARAMETER_DOUBLE_ARRAY: ('Double values are:', 'double_array_value'),
    ParameterType.PARAMETER_STRING_ARRAY: ('String values are:', 'string_array_value'),
}


def _names(session: Session, node: str) -> list[str]:
    response = session.ask(ListParameters, f'{node}/list_parameters', ListParameters.Request())
    return sorted(response.result.names)


def _values(session: Session, node: str, names: list[str]) -> list[ParameterValue]:
    request = GetParameters.Request(names=names)
    return list(session.ask(GetParameters, f'{node}/get_parameters', request).values)


def _list_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('node_name', nargs='?', help='without it, all nodes')


def _list(args: Namespace) -> None:
    with Session(args) as session:
        if args.node_name:
            for name in _names(session, session.find_node(args.node_name)):
                say(f'  {name}')
            return
        session.settle()
        services = dict(session.node.get_service_names_and_types())
        for node in session.node_names():
            if f'{node}/list_parameters' in services:
                _list_one(session, node)


def _list_one(session: Session, node: str) -> None:
    """Show the parameter names of a node; one that does not respond is reported and skipped."""
    try:
        names = _names(session, node)
    except ShimError as error:
        print(f"Exception while calling service of node '{node}': {error}", file=sys.stderr)
        return
    say(f'{node}:')
    for name in names:
        say(f'  {name}')


def _get_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('node_name')
    parser.add_argument('parameter_name')
    parser.add_argument('--hide-type', action='store_true', help='only the value')


def _get(args: Namespace) -> None:
    with Session(args) as session:
        node = session.find_node(args.node_name)
        found = _values(session, node, [args.parameter_name])
    if not found or found[0].type == ParameterType.PARAMETER_NOT_SET:
        raise ShimError(f"Parameter not set: '{args.parameter_name}' of {node}")
    label, field = _FIELDS[found[0].type]
    value = getattr(found[0], field)
    say(f'{value}' if args.hide_type else f'{label} {value}')


def _set_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('node_name')
    parser.add_argument('parameter_name')
    parser.add_argument('value', help='in YAML: 1.5 is a double, 1 an integer')


def _set(args: Namespace) -> None:
    parameter = Parameter(name=args.parameter_name, value=_read(args.value))
    request = SetParameters.Request(parameters=[parameter])
    with Session(args) as session:
        node = session.find_node(args.node_name)
        result = session.ask(SetParameters, f'{node}/set_parameters', request).results[0]
    reason = f': {result.reason}' if result.reason else ''
    if result.successful:
        say(f'Set parameter successful{reason}')
        return
    # The real command has exit code 0 here, too.
    print(f'Setting parameter failed{reason}', file=sys.stderr)


def _read(text: str) -> ParameterValue:
    try:
        return get_parameter_value(text)
    except (yaml.YAMLError, AssertionError):
        # Values that are no parameters in YAML are texts: `[draft`, a date.
        return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)


def _dump_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('node_name')


def _dump(args: Namespace) -> None:
    with Session(args) as session:
        node = session.find_node(args.node_name)
        names = _names(session, node)
        found = _values(session, node, names)
    tree: dict[str, Any] = {}
    for name, value in zip(names, found, strict=True):
        *folders, last = name.split('.')
        branch = tree
        for folder in folders:
            branch = branch.setdefault(folder, {})
        branch[last] = _plain(value)
    say(yaml.dump({node: {'ros__parameters': tree}}, default_flow_style=False))


def _plain(value: ParameterValue) -> Any:
    if value.type not in _FIELDS:
        return None
    label, field = _FIELDS[value.type]
    found = getattr(value, field)
    return list(found) if 'values' in label else found


VERBS = {
    'dump': Verb('All parameters of a node, as a parameter file.', _dump_arguments, _dump),
    'get': Verb('Value of a parameter.', _get_arguments, _get),
    'list': Verb('Names of the parameters of a node, or of all.', _list_arguments, _list),
    'set': Verb('Set a parameter.', _set_arguments, _set),
}
