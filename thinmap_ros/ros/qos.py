"""Quality of service of the topics, by kind of data."""

from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from rosbags.interfaces import Qos

from thinmap_ros.logs.storage import depth, is_latched, is_reliable

SENSOR = qos_profile_sensor_data
STREAM = QoSProfile(
    depth=50, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE
)
LATCHED = QoSProfile(
    depth=1,
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
# Of maps of several robots, the newest of each.
TILES = QoSProfile(
    depth=50, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
# All of a map: a subscriber that comes late gets them.
KEYFRAMES = QoSProfile(
    depth=16_384,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
TRANSFORMS = QoSProfile(
    depth=100, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE
)
# Read once a second: those of a robot that publishes each joint at 50 Hz.
QUEUED_TRANSFORMS = QoSProfile(
    depth=1000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE
)
STATIC_TRANSFORMS = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


def as_recorded(topic: str, offers: list[Qos]) -> QoSProfile:
    """Quality of service of a topic of a bag when it is played: as it was recorded."""
    latched = is_latched(topic, offers)
    # Static transforms have many publishers; a late subscriber needs all of them.
    least = (
        STATIC_TRANSFORMS.depth if topic.endswith('tf_static') else 1 if latched else STREAM.depth
    )
    return QoSProfile(
        depth=max(depth(offers), least),
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE
        if is_reliable(offers)
        else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def mismatch(offered: QoSProfile, requested: QoSProfile) -> str:
    """What a subscription requests and a publisher does not offer; '' where they match."""
    faults = []
    if (
        requested.reliability == ReliabilityPolicy.RELIABLE
        and offered.reliability == ReliabilityPolicy.BEST_EFFORT
    ):
        faults.append('best effort offered, reliable requested')
    if (
        requested.durability == DurabilityPolicy.TRANSIENT_LOCAL
        and offered.durability == DurabilityPolicy.VOLATILE
    ):
        faults.append('volatile offered, transient local requested')
    return ', '.join(faults)
