"""`ros2 service`."""

import sys
from argparse import ArgumentParser, Namespace

from rclpy.node import Node

from ros2_shim import values
from ros2_shim.named import Named
from ros2_shim.session import Session
from ros2_shim.verbs import Verb, say

_SERVICES = Named('service', Node.get_service_names_and_types)


def _call_arguments(parser: ArgumentParser) -> None:
    parser.add_argument('service_name')
    parser.add_argument('service_type', help='as in std_srvs/srv/Trigger')
    group = parser.add_mutually_exclusive_group()
    group.add_argument('values', nargs='?', default='{}', help="as in '{data: true}'")
    group.add_argument('--stdin', action='store_true', help='read the values from stdin')


def _call(args: Namespace) -> None:
    kind = values.type_named(args.service_type, 'srv')
    text = sys.stdin.read() if args.stdin else args.values
    request = values.fill(kind.Request(), values.mapping(text))
    with Session(args) as session:
        name = session.full_name(args.service_name, 'service')
        client = session.node.create_client(kind, name)
        if not client.service_is_ready():
            say('waiting for service to become available...')
        session.until(client.service_is_ready)
        session.introduce(session.server_of(name))
        say(f'requester: making request: {request!r}\n')
        say(f'response:\n{session.result(client.call_async(request))!r}\n')


VERBS = {
    'call': Verb('Call a service.', _call_arguments, _call),
    'list': _SERVICES.list_verb,
    'type': _SERVICES.type_verb,
}
