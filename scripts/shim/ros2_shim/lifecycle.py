"""`ros2 lifecycle set`."""

import sys
from argparse import Namespace

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions

from ros2_shim.session import Session
from ros2_shim.verb import SPIN_TIME, ShimError, Verb, argument, say


def _set(args: Namespace) -> None:
    with Session(args) as session:
        node = session.find_node(args.node_name)
        request = ChangeState.Request(transition=_transition(session, node, args.transition))
        response = session.ask(ChangeState, f'{node}/change_state', request)
    if response.success:
        say('Transitioning successful')
        return
    # The real command has exit code 0 here, too.
    print('Transitioning failed', file=sys.stderr)


def _transition(session: Session, node: str, wanted: str) -> Transition:
    """An available transition of a node by its label or number."""
    name = f'{node}/get_available_transitions'
    response = session.ask(GetAvailableTransitions, name, GetAvailableTransitions.Request())
    known = [each.transition for each in response.available_transitions]
    for transition in known:
        if wanted in (transition.label, str(transition.id)):
            return transition
    available = ', '.join(f'{each.label} [{each.id}]' for each in known)
    raise ShimError(f"Unknown transition requested: '{wanted}', available ones are: {available}")


VERBS = {
    'set': Verb(
        'Make a transition.',
        _set,
        (
            argument('node_name'),
            argument('transition', help='configure, activate, deactivate, cleanup, shutdown'),
            SPIN_TIME,
        ),
    ),
}
