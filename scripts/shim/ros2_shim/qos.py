"""QoS profiles of subscriptions and publishers."""

from argparse import ArgumentParser, Namespace
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from ros2_shim.session import Session
from ros2_shim.verbs import positive_int, say

_RELIABILITY = {
    'reliable': ReliabilityPolicy.RELIABLE,
    'best_effort': ReliabilityPolicy.BEST_EFFORT,
}
_DURABILITY = {
    'transient_local': DurabilityPolicy.TRANSIENT_LOCAL,
    'volatile': DurabilityPolicy.VOLATILE,
}
_DEPTH = 10
_QUIET_S = 0.5


def add_arguments(parser: ArgumentParser) -> None:
    """Add options that override the chosen profile."""
    parser.add_argument('--qos-reliability', choices=_RELIABILITY)
    parser.add_argument('--qos-durability', choices=_DURABILITY)
    parser.add_argument('--qos-depth', type=positive_int, default=_DEPTH, metavar='N')


def to_publish(args: Namespace) -> QoSProfile:
    """Profile of a publisher: reliable and volatile, unless the options differ."""
    return _profile(args, ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)


def to_hear(session: Session, topic: str, args: Namespace) -> QoSProfile:
    """Profile of a subscription: compatible with all publishers, or as in the options."""
    publishers = _publishers(session, topic)
    reliability = ReliabilityPolicy.BEST_EFFORT
    durability = DurabilityPolicy.VOLATILE
    reliable = [p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers]
    kept = [p.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers]
    if publishers and all(reliable):
        reliability = ReliabilityPolicy.RELIABLE
    if publishers and all(kept):
        durability = DurabilityPolicy.TRANSIENT_LOCAL
    if not args.qos_reliability and any(reliable) and not all(reliable):
        _warn('QoSReliabilityPolicy.RELIABLE', 'QoSReliabilityPolicy.BEST_EFFORT')
    if not args.qos_durability and any(kept) and not all(kept):
        _warn('QoSDurabilityPolicy.TRANSIENT_LOCAL', 'QoSDurabilityPolicy.VOLATILE')
    return _profile(args, reliability, durability)


def _publishers(session: Session, topic: str) -> list[Any]:
    """Publishers of a topic, after discovery has settled."""
    node = session.node
    session.found(lambda: node.count_publishers(topic))
    count = 0

    def is_new() -> bool:
        return bool(node.count_publishers(topic) != count)

    while is_new():
        count = node.count_publishers(topic)
        session.until(is_new, _QUIET_S)
    return list(node.get_publishers_info_by_topic(topic))


def _warn(policy: str, instead: str) -> None:
    say(
        f'Some, but not all, publishers are offering {policy}. '
        f'Falling back to {instead} as it will connect to all publishers'
    )


def _profile(
    args: Namespace, reliability: ReliabilityPolicy, durability: DurabilityPolicy
) -> QoSProfile:
    return QoSProfile(
        depth=args.qos_depth,
        reliability=_RELIABILITY.get(args.qos_reliability, reliability),
        durability=_DURABILITY.get(args.qos_durability, durability),
    )
