"""`ros2 service`."""

import sys
from argparse import ArgumentParser, Namespace

from ros2_shim import values
from ros2_shim.node import is_hidden
from ros2_shim.session import Session
from ros2_shim.verbs import ShimError, Verb, add_graph_arguments, say


def _list_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('-t', '--show-types', action='store_true', help='types, too')
    parser.add_argument('-c', '--count-services', action='store_true', help='only how many')
    parser.add_argument('--include-hidden-services', action='store_true', help='hidden ones, too')


def _list(args: Namespace) -> None:
    with Session(args) as session:
        session.settle()
        pairs = session.node.get_service_names_and_types()
    shown = [p for p in pairs if args.include_hidden_services or not is_hidden(p[0])]
    if args.count_services:
        say(str(len(shown)))
        return
    for name, types in shown:
        say(f'{name} [{", ".join(types)}]' if args.show_types else name)


def _type_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('service_name')


def _type(args: Namespace) -> None:
    with Session(args) as session:
        name = session.full_name(args.service_name, 'service')
        if not session.found(lambda: name in dict(session.node.get_service_names_and_types())):
            raise ShimError(f"Unknown service '{name}'")
        for kind in dict(session.node.get_service_names_and_types())[name]:
            say(kind)


def _call_arguments(parser: ArgumentParser) -> None:
    parser.add_argument('service_name')
    parser.add_argument('service_type', help='as in std_srvs/srv/Trigger')
    group = parser.add_mutually_exclusive_group()
    group.add_argument('values', nargs='?', default='{}', help="as in '{data: true}'")
    group.add_argument('--stdin', action='store_true', help='read the values there')


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
    'list': Verb('Names of all services.', _list_arguments, _list),
    'type': Verb('Type of a service.', _type_arguments, _type),
}
