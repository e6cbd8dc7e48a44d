"""Sources of the odometry of a bag: its topic, its transforms, or none."""

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.logs import decode
from thinmap_ros.logs.frames.bag_frames import BagFrames
from thinmap_ros.logs.log import OdometryEvent
from thinmap_ros.logs.transforms import OdometryFrames, TransformOdometry

TOPIC = 'topic'
TF = 'tf'
NONE = 'none'
SOURCES = (TOPIC, TF, NONE)


class BagOdometry(Protocol):
    """Odometry of a bag. name: for messages; topics: that it reads."""

    name: str
    topics: set[str]

    @property
    def missing(self) -> str:
        """What is missing for a sample, after a colon; '' if unknown."""
        ...

    def samples(self, message: Any) -> Iterator[OdometryEvent]:
        """Samples that a message of its topics completes. Raises InputError if it is unusable."""
        ...

    def at_scan(self, stamp_ns: int) -> Iterator[OdometryEvent]:
        """Samples at the stamp of a scan, before it."""
        ...


class OdometryOnTopic:
    """nav_msgs/Odometry, in the frames of the robot or in frames connected to them."""

    def __init__(self, topic: str, frames: OdometryFrames) -> None:
        self.name = topic
        self.topics = {topic}
        self.missing = ''
        self._frames = frames

    def samples(self, message: Any) -> Iterator[OdometryEvent]:
        """The sample of a message."""
        T_odom_base = self._frames.pose(message)
        if not se2.is_bounded_pose(T_odom_base):
            raise InputError(
                f'pose {T_odom_base.tolist()}: expected finite numbers, at most '
                f'{se2.MAX_COORDINATE_M:g} m'
            )
        yield OdometryEvent(decode.stamp_ns(message), T_odom_base)

    def at_scan(self, stamp_ns: int) -> Iterator[OdometryEvent]:
        """No sample."""
        yield from ()


class OdometryByTransforms:
    """The transform from the odometry frame to that of the robot."""

    def __init__(self, frames: BagFrames) -> None:
        self.name = 'transforms'
        self.topics = frames.tf_topics
        self._transforms: TransformOdometry = frames.by_transforms()

    @property
    def missing(self) -> str:
        """What is missing of the chain of transforms."""
        return f': {self._transforms.missing} (--odom-frame, --base-frame)'

    def samples(self, message: Any) -> Iterator[OdometryEvent]:
        """The sample of the newest time at which all transforms are known, if that is new."""
        invalid: InputError | None = None
        for transform in message.transforms:
            try:
                self._transforms.add(transform, is_static=False)
            except InputError as error:
                invalid = error
        sample = self._transforms.next_sample()
        if sample is not None:
            yield OdometryEvent(*sample)
        if invalid is not None:
            raise invalid

    def at_scan(self, stamp_ns: int) -> Iterator[OdometryEvent]:
        """No sample."""
        yield from ()


class NoOdometry:
    """The robot never moves in its odometry frame: there is a sample at each scan."""

    def __init__(self) -> None:
        self.name = 'scans'
        self.topics: set[str] = set()
        self.missing = ''

    def samples(self, message: Any) -> Iterator[OdometryEvent]:
        """No sample."""
        yield from ()

    def at_scan(self, stamp_ns: int) -> Iterator[OdometryEvent]:
        """A sample at the origin."""
        yield OdometryEvent(stamp_ns, np.zeros(3), is_measured=False)
