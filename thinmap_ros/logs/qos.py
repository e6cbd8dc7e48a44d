"""Qualities of service as bags hold them.

Written with each topic, so that players offer what was offered.
"""

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
from thinmap_ros.files.yaml import parse_yaml

KEY = 'offered_qos_profiles'
"""Key of a channel's metadata in an MCAP file; its value is YAML."""
_FOREVER = QosTime(2147483647, 4294967295)
_DEEPEST_QUEUE = 100_000


def of_channel(channel: Channel) -> list[Qos]:
    """QoS that the publishers of a channel offered; empty where it says none that can be read."""
    text = channel.metadata.get(KEY, '')
    try:
        content: Any = parse_yaml(text) if text else []
        offers = parse_qos(content) if content else []
        depths = [offer.depth for offer in offers]
    except (InputError, KeyError, TypeError, ValueError, AttributeError):
        return []
    good = all(isinstance(depth, int) and 0 <= depth < _DEEPEST_QUEUE for depth in depths)
    return offers if good else []


def recorded(depth: int, reliable: bool, latched: bool) -> Qos:
    """What is written of a topic: depth, whether it is reliable, whether it is transient local."""
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
    """Whether who comes late is to hear the last message of a topic.

    All its publishers offered that.

    Converted bags say nothing about static transforms, which are always latched.
    """
    if not offers:
        return topic.endswith('tf_static')
    return all(offer.durability is QosDurability.TRANSIENT_LOCAL for offer in offers)


def is_reliable(offers: list[Qos]) -> bool:
    """Whether a topic is to be offered as reliable: so it is where nothing else was recorded."""
    return all(offer.reliability is not QosReliability.BEST_EFFORT for offer in offers)


def depth(offers: list[Qos]) -> int:
    """How many messages of a topic its publishers kept, all together.

    The graph does not always tell.
    """
    return sum(max(offer.depth, 1) for offer in offers)
