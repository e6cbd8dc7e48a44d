"""Qualities of service as bags hold them: written with each topic, so that players offer what was offered."""

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

_FOREVER = QosTime(2147483647, 4294967295)


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
    """Whether who comes late is to hear the last message of a topic: all its publishers offered that.

    Converted bags say nothing about static transforms, which are always latched.
    """
    if not offers:
        return topic.endswith('tf_static')
    return all(offer.durability is QosDurability.TRANSIENT_LOCAL for offer in offers)


def is_reliable(offers: list[Qos]) -> bool:
    """Whether a topic is to be offered as reliable: so it is where nothing else was recorded."""
    return all(offer.reliability is not QosReliability.BEST_EFFORT for offer in offers)


def depth(offers: list[Qos]) -> int:
    """How many messages of a topic its publishers kept, all together; the graph does not always tell."""
    return sum(max(offer.depth, 1) for offer in offers)
