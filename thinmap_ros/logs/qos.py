"""QoS profiles in bags, stored with each topic so that players can offer the same."""

from typing import Any

from mcap.records import Channel
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2.metadata import parse_qos

from thinmap_ros.core.errors import InputError
from thinmap_ros.files.safe import LOGS, parse_yaml

KEY = 'offered_qos_profiles'
"""Key of a channel's metadata in an MCAP file; its value is YAML."""
_FOREVER = QosTime(2147483647, 4294967295)


def of_channel(channel: Channel) -> list[Qos]:
    """QoS of the publishers of a channel; empty if missing or unreadable."""
    text = channel.metadata.get(KEY, '')
    try:
        content: Any = parse_yaml(text) if text else []
        offers = parse_qos(content) if content else []
        depths = [offer.depth for offer in offers]
    except (InputError, KeyError, TypeError, ValueError, AttributeError):
        return []
    good = all(isinstance(depth, int) and 0 <= depth < LOGS.queue_depth for depth in depths)
    return offers if good else []


def recorded(depth: int, reliable: bool, latched: bool) -> Qos:
    """Stored QoS of a topic: depth, reliability, durability."""
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=_FOREVER,
        lifespan=_FOREVER,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_FOREVER,
        avoid_ros_namespace_conventions=False,
    )


def is_latched(topic: str, offers: list[Qos]) -> bool:
    """Whether late subscribers receive the last message of a topic: all publishers offered it.

    Converted bags have no QoS of static transforms, which are always latched.
    """
    if not offers:
        return topic.endswith('tf_static')
    return all(offer.durability is QosDurability.TRANSIENT_LOCAL for offer in offers)


def is_reliable(offers: list[Qos]) -> bool:
    """Whether to offer a topic as reliable; the default if no QoS was recorded."""
    return all(offer.reliability is not QosReliability.BEST_EFFORT for offer in offers)


def depth(offers: list[Qos]) -> int:
    """Total queue depth of the publishers of a topic; the graph does not always report it."""
    return sum(max(offer.depth, 1) for offer in offers)
