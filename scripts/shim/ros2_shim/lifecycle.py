"""`ros2 lifecycle`: states and transitions of lifecycle nodes."""

import sys
from argparse import ArgumentParser, Namespace
from typing import Any

from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState

from ros2_shim.session import Session
from ros2_shim.verbs import ShimError, Verb, add_graph_arguments, say


def _with_states(session: Session, hidden: bool) -> list[str]:
    """Names of the lifecycle nodes of a graph."""
    session.settle()
    services = dict(session.node.get_service_names_and_types())
    names = session.node_names(hidden)
    kind = 'lifecycle_msgs/srv/GetState'
    return [name for name in names if kind in services.get(f'{name}/get_state', ())]


def _nodes_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('-a', '--all', action='store_true', help='hidden ones, too')
    parser.add_argument('-c', '--count-nodes', action='store_true', help='only the number')


def _nodes(args: Namespace) -> None:
    with Session(args) as session:
        names = _with_states(session, args.all)
    if args.count_nodes:
        say(str(len(names)))
        return
    for name in names:
        say(name)


def _get_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('node_name', nargs='?', help='without it, all lifecycle nodes')


def _get(args: Namespace) -> None:
    with Session(args) as session:
        if args.node_name:
            say(_state(session, session.find_node(args.node_name)))
            return
        for name in _with_states(session, hidden=False):
            say(f'{name}: {_state(session, name)}')


def _state(session: Session, node: str) -> str:
    state = session.ask(GetState, f'{node}/get_state', GetState.Request()).current_state
    return f'{state.label} [{state.id}]'


def _transitions(session: Session, node: str) -> list[Any]:
    request = GetAvailableTransitions.Request()
    name = f'{node}/get_available_transitions'
    return list(session.ask(GetAvailableTransitions, name, request).available_transitions)


def _list_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('node_name')


def _list(args: Namespace) -> None:
    with Session(args) as session:
        for each in _transitions(session, session.find_node(args.node_name)):
            say(f'- {each.transition.label} [{each.transition.id}]')
            say(f'\tStart: {each.start_state.label}')
            say(f'\tGoal: {each.goal_state.label}')


def _set_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('node_name')
    parser.add_argument('transition', help='configure, activate, deactivate, cleanup, shutdown')


def _set(args: Namespace) -> None:
    with Session(args) as session:
        node = session.find_node(args.node_name)
        known = [each.transition for each in _transitions(session, node)]
        wanted = [t for t in known if args.transition in (t.label, str(t.id))]
        if not wanted:
            available = ', '.join(f'{t.label} [{t.id}]' for t in known)
            raise ShimError(
                f"Unknown transition requested: '{args.transition}', "
                f'available ones are: {available}'
            )
        request = ChangeState.Request(transition=wanted[0])
        done = session.ask(ChangeState, f'{node}/change_state', request).success
    if done:
        say('Transitioning successful')
        return
    # The real command has exit code 0 here, too.
    print('Transitioning failed', file=sys.stderr)


VERBS = {
    'get': Verb('State of a lifecycle node, or of all.', _get_arguments, _get),
    'list': Verb('Available transitions of a node.', _list_arguments, _list),
    'nodes': Verb('Names of all lifecycle nodes.', _nodes_arguments, _nodes),
    'set': Verb('Make a transition.', _set_arguments, _set),
}
