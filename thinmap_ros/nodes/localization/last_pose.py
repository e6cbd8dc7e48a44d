"""The last pose in a map, which survives a restart of the machine."""

import math
import os
import time
from pathlib import Path

import yaml
from rclpy.node import Node

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.se2 import Array
from thinmap_ros.files.safe import read_mapping, write_text

_WARN_PERIOD_S = 60.0
_KEYS = ('x', 'y', 'yaw')


class LastPose:
    """A small YAML file with the map and the last pose of the robot in it."""

    def __init__(self, node: Node, path: str, rate: float, map_name: str) -> None:
        """path: '' for the default; rate: of saving, 1/s; map_name: the pose belongs to it."""
        self._node = node
        self._path = Path(path) if path else _default_path(node)
        self._period_s = 1.0 / rate if rate > 0.0 else math.inf
        self._map_name = map_name
        self._saved_at_s = -math.inf
        self._unsaved: Array | None = None

    def load(self) -> Array | None:
        """The pose (3,) in this map; None without one: no file, a broken one, or another map."""
        if math.isinf(self._period_s) or not self._path.exists():
            return None
        try:
            content = read_mapping(self._path, 'the last pose of a localizer')
            pose = self._pose_of(content)
        except InputError as error:
            self._node.get_logger().warning(f'{error}: starting without a last pose')
            return None
        named = content.get('map')
        if named == self._map_name:
            return pose
        self._node.get_logger().info(
            f'{self._path}: pose in map {quoted(named)}, not in {quoted(self._map_name)}: '
            'starting without a last pose'
        )
        return None

    def save(self, T_map_base: Array) -> None:
        """Save a pose (3,), unless the last one was saved recently."""
        if math.isinf(self._period_s):
            return
        self._unsaved = T_map_base
        if time.monotonic() - self._saved_at_s >= self._period_s:
            self.save_latest()

    def save_latest(self) -> None:
        """Save the pose that was given last, if it is not saved: at the end of the node."""
        if self._unsaved is None:
            return
        self._saved_at_s = time.monotonic()
        values = zip(_KEYS, (round(value, 4) for value in self._unsaved.tolist()), strict=True)
        self._unsaved = None
        try:
            write_text(self._path, yaml.safe_dump({'map': self._map_name, **dict(values)}))
        except OSError as error:
            self._node.get_logger().warning(
                f'pose_file: {error.filename or self._path}: {error.strerror}: '
                'last pose not saved: expected a file that can be written',
                throttle_duration_sec=_WARN_PERIOD_S,
            )

    def _pose_of(self, content: dict[str, object]) -> Array:
        values = [content.get(key) for key in _KEYS]
        numbers = [float(value) for value in values if isinstance(value, int | float)]
        if len(numbers) != len(_KEYS) or not se2.is_bounded_pose(se2.pose(*numbers)):
            raise InputError(f'{self._path}: expected x, y (m) and yaw (rad)')
        return se2.pose(*numbers)


def _default_path(node: Node) -> Path:
    chosen = os.environ.get('XDG_STATE_HOME')
    state = Path(chosen) if chosen else Path.home() / '.local' / 'state'
    name = node.get_fully_qualified_name().strip('/').replace('/', '.')
    return state / 'thinmap' / f'{os.environ.get("ROS_DOMAIN_ID", "0")}.{name}.pose.yaml'
