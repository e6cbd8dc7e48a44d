"""`ros2 service call`."""

from argparse import Namespace

from ros2_shim import values
from ros2_shim.session import Session
from ros2_shim.verb import Verb, argument, say


def _call(args: Namespace) -> None:
    kind = values.type_named(args.service_type, 'srv')
    request = values.read(kind.Request, args.values)
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
    'call': Verb(
        'Call a service.',
        _call,
        (
            argument('service_name'),
            argument('service_type', help='as in std_srvs/srv/Trigger'),
            argument('values', nargs='?', default='{}', help="as in '{data: true}'"),
        ),
    ),
}
