"""`ros2 node`."""

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from typing import Any

from rclpy.action import (
    get_action_client_names_and_types_by_node,
    get_action_server_names_and_types_by_node,
)
from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden

from ros2_shim.session import Session, split
from ros2_shim.verbs import Verb, add_graph_arguments, say


def _list_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('-a', '--all', action='store_true', help='hidden ones, too')
    parser.add_argument('-c', '--count-nodes', action='store_true', help='only the number')


def _list(args: Namespace) -> None:
    with Session(args) as session:
        session.settle()
        names = session.node_names(args.all)
    if len(set(names)) < len(names):
        print(
            'WARNING: Be aware that there are nodes in the graph that share an exact name, '
            'which can have unintended side effects.',
            file=sys.stderr,
        )
    if args.count_nodes:
        say(str(len(names)))
        return
    for name in names:
        say(name)


def _info_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('node_name')
    parser.add_argument('--include-hidden', action='store_true', help='hidden topics, too')


def _info(args: Namespace) -> None:
    with Session(args) as session:
        full = session.find_node(args.node_name)
        session.settle()
        node = session.node
        parts: dict[str, Callable[[str, str], Any]] = {
            'Subscribers': node.get_subscriber_names_and_types_by_node,
            'Publishers': node.get_publisher_names_and_types_by_node,
            'Service Servers': node.get_service_names_and_types_by_node,
            'Service Clients': node.get_client_names_and_types_by_node,
            'Action Servers': lambda *n: get_action_server_names_and_types_by_node(node, *n),
            'Action Clients': lambda *n: get_action_client_names_and_types_by_node(node, *n),
        }
        say(full)
        for title, ask in parts.items():
            say(f'  {title}:')
            pairs = sorted(ask(*split(full)))
            shown = [p for p in pairs if args.include_hidden or not is_hidden(p[0])]
            say('\n'.join(f'    {name}: {", ".join(types)}' for name, types in shown))


def is_hidden(name: str) -> bool:
    """Whether a topic or service is hidden: internal to ROS."""
    return bool(topic_or_service_is_hidden(name))


VERBS = {
    'info': Verb('Topics, services and actions of a node.', _info_arguments, _info),
    'list': Verb('Names of all nodes.', _list_arguments, _list),
}
