"""`ros2 topic`: topics and their messages."""

import itertools
import statistics
import time
from argparse import Namespace
from collections import deque
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden

from ros2_shim import values
from ros2_shim.session import Session
from ros2_shim.verb import SPIN_TIME, ShimError, Verb, argument, flag, say

_MAX_LENGTH = 128
_MAX_ARRIVALS = 10001
_DEPTH = 10
_QUIET_S = 0.5
_REPORT_S = 1.0
_POLICIES = (
    ('reliability', ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT),
    ('durability', DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE),
)


def _types(session: Session, topic: str) -> list[str]:
    """Types of a topic; empty if it is unknown."""
    return list(dict(session.node.get_topic_names_and_types()).get(topic, []))


def _class_of(session: Session, topic: str) -> Any:
    types = _types(session, topic)
    if len(types) > 1:
        raise ShimError(
            f"Cannot echo topic '{topic}', as it contains more than one type: [{', '.join(types)}]"
        )
    return values.type_named(types[0], 'msg')


def _is_published(session: Session, topic: str) -> bool:
    """Wait until a topic has a type; one that has none in time is reported."""
    if session.found(lambda: _types(session, topic)):
        return True
    say(f'WARNING: topic [{topic}] does not appear to be published yet')
    return False


def _publishers(session: Session, topic: str) -> list[Any]:
    """Publishers of a topic, after discovery has settled."""
    node = session.node
    session.found(lambda: node.count_publishers(topic))
    count = -1

    def is_new() -> bool:
        return bool(node.count_publishers(topic) != count)

    while is_new():
        count = node.count_publishers(topic)
        session.until(is_new, _QUIET_S)
    return list(node.get_publishers_info_by_topic(topic))


def _compatible_qos(session: Session, topic: str) -> QoSProfile:
    """QoS of a subscription that all publishers of a topic can serve."""
    offers = [info.qos_profile for info in _publishers(session, topic)]
    policies = {}
    for name, better, worse in _POLICIES:
        offered = [getattr(offer, name) == better for offer in offers]
        policies[name] = better if offers and all(offered) else worse
        if any(offered) and not all(offered):
            say(
                f'Some, but not all, publishers are offering {_policy_name(better)}. '
                f'Falling back to {_policy_name(worse)} as it will connect to all publishers'
            )
    return QoSProfile(depth=_DEPTH, **policies)


def _policy_name(policy: Any) -> str:
    return f'QoS{type(policy).__name__}.{policy.name}'


def _list(args: Namespace) -> None:
    with Session(args) as session:
        session.settle()
        topics = session.node.get_topic_names_and_types()
    for name, types in topics:
        if args.include_hidden_topics or not topic_or_service_is_hidden(name):
            say(f'{name} [{", ".join(types)}]' if args.show_types else name)


def _echo(args: Namespace) -> None:
    given = values.type_named(args.message_type, 'msg') if args.message_type else None
    is_shown = False

    def show(message: Any) -> None:
        nonlocal is_shown
        if not (args.once and is_shown):
            say(_echoed(_part(message, args.field), args), '---\n')
        is_shown = True

    with Session(args) as session:
        topic = session.full_name(args.topic_name)
        if given is None and not _is_published(session, topic):
            raise ShimError('Could not determine the type for the passed topic')
        kind = given or _class_of(session, topic)
        session.node.create_subscription(kind, topic, show, _compatible_qos(session, topic))
        session.until(lambda: args.once and is_shown)


def _part(message: Any, path: str) -> Any:
    """Value of a field by its path, with dots for nested fields."""
    for field in filter(None, path.split('.')):
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
    return values.to_yaml(value, _MAX_LENGTH, args.no_arr, args.flow_style)


def _hz(args: Namespace) -> None:
    arrivals_s: deque[float] = deque(maxlen=_MAX_ARRIVALS)
    reported_s = time.monotonic()

    def is_due() -> bool:
        return len(arrivals_s) > 1 and arrivals_s[-1] >= reported_s + _REPORT_S

    with Session(args) as session:
        topic = session.full_name(args.topic_name)
        if not _is_published(session, topic):
            session.until(lambda: _types(session, topic))
        kind = _class_of(session, topic)
        profile = _compatible_qos(session, topic)
        # Not decoded: only the time of arrival is needed.
        session.node.create_subscription(
            kind, topic, lambda _: arrivals_s.append(time.monotonic()), profile, raw=True
        )
        while session.until(is_due):
            reported_s = arrivals_s[-1]
            say(_rate(list(arrivals_s)))


def _rate(arrivals_s: list[float]) -> str:
    """Mean rate of messages with these times of arrival (s), and their standard deviation."""
    gaps_s = [end - begin for begin, end in itertools.pairwise(arrivals_s)]
    return (
        f'average rate: {1.0 / statistics.fmean(gaps_s):.3f}\n\tmin: {min(gaps_s):.3f}s '
        f'max: {max(gaps_s):.3f}s std dev: {statistics.pstdev(gaps_s):.5f}s '
        f'window: {len(gaps_s)}'
    )


_TOPIC = argument('topic_name')
VERBS = {
    'echo': Verb(
        'Print the messages of a topic.',
        _echo,
        (
            _TOPIC,
            argument('message_type', nargs='?', help='as in std_msgs/msg/String'),
            flag('--once', 'the first message only'),
            argument('--field', metavar='F', default='', help='as in pose.pose.position'),
            flag('--no-arr', 'show only the length of sequences'),
            flag('--flow-style', 'in one line'),
            SPIN_TIME,
        ),
    ),
    'hz': Verb('Rate of the messages of a topic.', _hz, (_TOPIC, SPIN_TIME)),
    'list': Verb(
        'Names of all topics.',
        _list,
        (
            flag('-t --show-types', 'types, too'),
            flag('--include-hidden-topics', 'hidden ones, too'),
            SPIN_TIME,
        ),
    ),
}
