"""`ros2 param`: parameters of running nodes."""

import sys
from argparse import Namespace

import yaml
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import get_parameter_value

from ros2_shim.session import Session
from ros2_shim.verb import SPIN_TIME, ShimError, Verb, argument, flag, say

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


def _get(args: Namespace) -> None:
    request = GetParameters.Request(names=[args.parameter_name])
    with Session(args) as session:
        node = session.find_node(args.node_name)
        found = session.ask(GetParameters, f'{node}/get_parameters', request).values
    if not found or found[0].type == ParameterType.PARAMETER_NOT_SET:
        raise ShimError(f"Parameter not set: '{args.parameter_name}' of {node}")
    label, field = _FIELDS[found[0].type]
    value = getattr(found[0], field)
    say(f'{value}' if args.hide_type else f'{label} {value}')


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


_NAMES = (argument('node_name'), argument('parameter_name'))
VERBS = {
    'get': Verb(
        'Value of a parameter.', _get, (*_NAMES, flag('--hide-type', 'only the value'), SPIN_TIME)
    ),
    'set': Verb(
        'Set a parameter.',
        _set,
        (*_NAMES, argument('value', help='in YAML: 1.5 is a double, 1 an integer'), SPIN_TIME),
    ),
}
