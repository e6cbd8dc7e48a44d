"""`ros2 topic`: topics and their messages."""

import itertools
import time
from argparse import ArgumentParser, Namespace
from typing import Any

from rclpy.node import Node

from ros2_shim import qos, values
from ros2_shim.named import Named
from ros2_shim.rates import Rates
from ros2_shim.session import Session
from ros2_shim.verbs import (
    ShimError,
    Verb,
    add_graph_arguments,
    positive_float,
    positive_int,
    say,
)

_TRUNCATE = 128
_TOPICS = Named('topic', Node.get_topic_names_and_types)


def _single_type(session: Session, topic: str) -> Any:
    types = _TOPICS.types(session, topic)
    if len(types) > 1:
        raise ShimError(
            f"Cannot echo topic '{topic}', as it contains more than one type: [{', '.join(types)}]"
        )
    return values.type_named(types[0], 'msg')


def _not_published(topic: str) -> None:
    say(f'WARNING: topic [{topic}] does not appear to be published yet')


# info ------------------------------------------------------------------------------------------


def _info_arguments(parser: ArgumentParser) -> None:
    _TOPICS.name_arguments(parser)
    parser.add_argument(
        '-v', '--verbose', action='store_true', help='each publisher and subscription, with its QoS'
    )


def _info(args: Namespace) -> None:
    end = '\n\n' if args.verbose else '\n'
    with Session(args) as session:
        topic = _TOPICS.known(session, args.name)
        session.settle()
        types = _TOPICS.types(session, topic)
        node = session.node
        say(f'Type: {types[0] if len(types) == 1 else types}', end)
        say(f'Publisher count: {node.count_publishers(topic)}', end)
        for info in node.get_publishers_info_by_topic(topic) if args.verbose else ():
            say(str(info), end)
        say(f'Subscription count: {node.count_subscribers(topic)}', end)
        for info in node.get_subscriptions_info_by_topic(topic) if args.verbose else ():
            say(str(info), end)


# echo ------------------------------------------------------------------------------------------


def _echo_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('topic_name')
    parser.add_argument('message_type', nargs='?', help='as in std_msgs/msg/String')
    parser.add_argument('--once', action='store_true', help='the first message only')
    parser.add_argument('--field', metavar='F', help='a part of it, as in pose.pose.position')
    parser.add_argument('-f', '--full-length', action='store_true', help='do not truncate')
    parser.add_argument('-l', '--truncate-length', type=positive_int, default=_TRUNCATE)
    parser.add_argument('--no-arr', action='store_true', help='show only the length of sequences')
    parser.add_argument('--no-str', action='store_true', help='show only the length of texts')
    parser.add_argument('--flow-style', action='store_true', help='in one line')
    qos.add_arguments(parser)


def _echo(args: Namespace) -> None:
    heard = 0
    given = values.type_named(args.message_type, 'msg') if args.message_type else None
    with Session(args) as session:
        topic = session.full_name(args.topic_name)
        if given is None and not session.found(lambda: _TOPICS.types(session, topic)):
            _not_published(topic)
            raise ShimError('Could not determine the type for the passed topic')
        kind = given or _single_type(session, topic)

        def show(message: Any) -> None:
            nonlocal heard
            if args.once and heard:
                return
            heard += 1
            say(_echoed(_part(message, args.field), args), '---\n')

        profile = qos.to_hear(session, topic, args)
        session.node.create_subscription(kind, topic, show, profile)
        session.until(lambda: args.once and heard)


def _part(message: Any, path: str | None) -> Any:
    """Value of a field by its path, with dots for nested fields."""
    for field in filter(None, (path or '').split('.')):
        if not hasattr(message, 'get_fields_and_field_types'):
            raise ShimError(f"Invalid field '{path}': what holds '{field}' is not a message")
        fields = message.get_fields_and_field_types()
        if field not in fields:
            raise ShimError(f"Invalid field '{path}': no '{field}', there is {', '.join(fields)}")
        message = getattr(message, field)
    return message


def _echoed(value: Any, args: Namespace) -> str:
    if not hasattr(value, 'get_fields_and_field_types'):
        return f'{value}\n'
    longest = None if args.full_length else args.truncate_length
    return values.to_yaml(value, longest, args.no_arr, args.no_str, args.flow_style)


# hz --------------------------------------------------------------------------------------------


def _hz_arguments(parser: ArgumentParser) -> None:
    add_graph_arguments(parser)
    parser.add_argument('topic_name')
    parser.add_argument('-w', '--window', type=positive_int, default=10000, metavar='N')
    qos.add_arguments(parser)


def _hz(args: Namespace) -> None:
    rates = Rates(args.window)
    with Session(args) as session:
        topic = session.full_name(args.topic_name)
        if not session.found(lambda: _TOPICS.types(session, topic)):
            _not_published(topic)
            session.until(lambda: _TOPICS.types(session, topic))
        kind = _single_type(session, topic)
        profile = qos.to_hear(session, topic, args)

        def hear(_: bytes) -> None:
            text = rates.heard(time.monotonic())
            if text:
                say(text)

        # Not decoded: only the time of arrival is needed.
        session.node.create_subscription(kind, topic, hear, profile, raw=True)
        session.until(lambda: False)


# pub -------------------------------------------------------------------------------------------


def _pub_arguments(parser: ArgumentParser) -> None:
    parser.add_argument('topic_name')
    parser.add_argument('message_type', help='as in std_msgs/msg/String')
    parser.add_argument('values', nargs='?', default='{}', help="as in '{data: text}'")
    parser.add_argument('-r', '--rate', type=positive_float, default=1.0, metavar='HZ')
    parser.add_argument(
        '-p', '--print', type=int, default=1, metavar='N', help='print every N-th message only'
    )
    group = parser.add_mutually_exclusive_group()
    group.add_argument('-1', '--once', action='store_true', help='one message, then end')
    group.add_argument(
        '-t', '--times', type=positive_int, default=0, help='number of messages, then end'
    )
    parser.add_argument(
        '-w',
        '--wait-matching-subscriptions',
        type=int,
        metavar='N',
        help='number of subscriptions to wait for (default: 1 with --once and --times, else 0)',
    )
    parser.add_argument('--keep-alive', type=float, default=0.1, metavar='SECONDS')
    qos.add_arguments(parser)


def _pub(args: Namespace) -> None:
    kind = values.type_named(args.message_type, 'msg')
    fields = values.mapping(args.values)
    times = 1 if args.once else args.times
    waited_for = args.wait_matching_subscriptions
    if waited_for is None:
        waited_for = 1 if times else 0
    with Session(args) as session:

        def now() -> Any:
            return session.node.get_clock().now().to_msg()

        values.fill(kind(), fields, now)
        topic = session.full_name(args.topic_name)
        publisher = session.node.create_publisher(kind, topic, qos.to_publish(args))
        while not session.until(lambda: publisher.get_subscription_count() >= waited_for, 1.0):
            say(f'Waiting for at least {waited_for} matching subscription(s)...')
        say('publisher: beginning loop')
        beats = session.beats(1.0 / args.rate)
        for count in range(1, times + 1) if times else itertools.count(1):
            next(beats)
            message = values.fill(kind(), fields, now)
            if args.print > 0 and count % args.print == 0:
                say(f'publishing #{count}: {message!r}\n')
            publisher.publish(message)
        # The last message must be sent before the process ends.
        session.until(lambda: False, args.keep_alive)


VERBS = {
    'echo': Verb('Print the messages of a topic.', _echo_arguments, _echo),
    'hz': Verb('Rate of the messages of a topic.', _hz_arguments, _hz),
    'info': Verb('Publishers and subscriptions of a topic.', _info_arguments, _info),
    'list': _TOPICS.list_verb,
    'pub': Verb('Publish messages on a topic.', _pub_arguments, _pub),
    'type': _TOPICS.type_verb,
}
