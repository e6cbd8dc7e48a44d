"""Writes rosbag2 folders and MCAP files, atomically or live."""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, cast

import numpy as np
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.topology.graph import TopologicalMap, flat_topology
from thinmap_ros.logs.storage import recorded


class BagWriter:
    """Writes a rosbag2 folder with an MCAP file, or only that file if the path ends in .mcap.

    As a context manager it writes to a temporary path and renames it when the block succeeds, so
    that no partial bag is mistaken for a complete one. `live` writes under the final name from the
    start, for recorders: messages since the last `flush` may be lost. `compressed`: with zstd, by
    chunk. An older bag of that name is replaced. Raises InputError if the path is something else.
    """

    def __init__(
        self,
        path: Path,
        live: bool = False,
        definitions: dict[str, str] | None = None,
        compressed: bool = False,
    ) -> None:
        self._path = path
        self._folder = path if live else _aside(path)
        self.typestore: Typestore = get_typestore(Stores.ROS2_JAZZY)
        self.add_definitions(definitions or {})
        self._connections: dict[str, Connection] = {}
        _check_replaceable(path)
        _remove(self._folder)
        self._folder.parent.mkdir(parents=True, exist_ok=True)
        self._writer = Writer(self._folder, version=9, storage_plugin=StoragePlugin.MCAP)
        if compressed:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()

    def __enter__(self) -> 'BagWriter':
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
            if kind is None and self._folder != self._path:
                _rename(self._folder, self._path)
        finally:
            if self._folder != self._path or kind is not None:
                _remove(self._folder)

    def add_definitions(self, definitions: dict[str, str]) -> None:
        """Add message definitions, texts by full name, for types outside of ROS."""
        for name, text in definitions.items():
            if name not in self.typestore.types:
                self.typestore.register(get_types_from_msg(text, name))

    def write(self, topic: str, type_name: str, log_ns: int, message: Any) -> None:
        """Write a message: its CDR bytes, or a message object of the typestore."""
        if topic not in self._connections:
            self.add_topic(
                topic, type_name, [recorded(1, True, True)] if topic.endswith('tf_static') else []
            )
        if not isinstance(message, bytes | memoryview):
            message = self.typestore.serialize_cdr(message, type_name)
        self._writer.write(self._connections[topic], log_ns, message)

    def add_topic(self, topic: str, type_name: str, offers: Sequence[Qos]) -> None:
        """Add a topic before its first message, with the QoS of its publishers.

        Raises InputError if the definition of its type is unknown.
        """
        try:
            self._connections[topic] = self._writer.add_connection(
                topic, type_name, typestore=self.typestore, offered_qos_profiles=offers
            )
        except TypesysError as error:
            raise InputError(f'{topic}: {" ".join(str(error).split())}') from error

    def flush(self) -> None:
        """Close the current chunk and sync it to disk, so that it survives a crash."""
        storage = cast(McapWriter, self._writer.storage)
        if storage.chunk.msgs:
            storage.close_chunk()
            storage.bio.flush()
            os.fdatasync(storage.bio.fileno())

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()


@contextmanager
def temporary_bag(path: Path) -> Iterator[Path]:
    """Yield an empty folder, whose content becomes the bag `path` when the block succeeds.

    Its content: NAME.mcap and metadata.yaml. An older bag of that name is replaced. Raises
    InputError if the path is something else.
    """
    _check_replaceable(path)
    folder = _aside(path)
    _remove(folder)
    folder.mkdir(parents=True)
    try:
        yield folder
        _rename(folder, path)
    finally:
        _remove(folder)


def _aside(path: Path) -> Path:
    return path.with_name(f'.{path.name}.{os.getpid()}.part')


def _rename(folder: Path, path: Path) -> None:
    (file,) = folder.glob('*.mcap')
    if path.suffix == '.mcap':
        file.replace(path)
        return
    # The file has the name of the folder, and the metadata have that of the file.
    name = file.name.replace(folder.name, path.name)
    metadata = folder / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace(file.name, name))
    file.rename(folder / name)
    _remove(path)
    folder.rename(path)


def _check_replaceable(path: Path) -> None:
    """Raise InputError if the path exists and is no bag: it would be overwritten."""
    if path.is_dir() and path.suffix != '.mcap':
        others = [
            file.name
            for file in path.iterdir()
            if file.suffix != '.mcap' and file.name != 'metadata.yaml'
        ]
        if not others:
            return
        raise InputError(
            f'{path}: a folder with {min(others)} in it: expected a new name or an older bag'
        )
    if path.exists() and not (path.is_file() and path.suffix == '.mcap'):
        raise InputError(f'{path}: exists and is no bag: expected a new name or an older bag')


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


class BagObjects:
    """Makes message objects of core values, without ROS: of the types of a typestore."""

    def __init__(self, types: dict[str, Any]) -> None:
        self._types = types

    def _make(self, name: str, **fields: Any) -> Any:
        return self._types[name](**fields)

    def header(self, frame_id: str, ns: int) -> Any:
        """std_msgs/Header."""
        stamp = self._make(
            'builtin_interfaces/msg/Time', sec=ns // SECOND_NS, nanosec=ns % SECOND_NS
        )
        return self._make('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)

    def _rotation(self, yaw: float) -> Any:
        half = yaw / 2.0
        return self._make(
            'geometry_msgs/msg/Quaternion',
            x=0.0,
            y=0.0,
            z=float(np.sin(half)),
            w=float(np.cos(half)),
        )

    def _vector(self, kind: str, x: float = 0.0, y: float = 0.0) -> Any:
        return self._make(f'geometry_msgs/msg/{kind}', x=float(x), y=float(y), z=0.0)

    def _pose(self, T: Array) -> Any:
        position = self._vector('Point', T[0], T[1])
        return self._make(
            'geometry_msgs/msg/Pose', position=position, orientation=self._rotation(T[2])
        )

    def _pose_with_covariance(self, T: Array, covariance: Array) -> Any:
        full = np.zeros((6, 6))
        full[np.ix_((0, 1, 5), (0, 1, 5))] = covariance
        return self._make(
            'geometry_msgs/msg/PoseWithCovariance', pose=self._pose(T), covariance=full.ravel()
        )

    def odometry(self, ns: int, T: Array) -> Any:
        """nav_msgs/Odometry of a pose T_odom_base (3,)."""
        twist = self._make(
            'geometry_msgs/msg/Twist',
            linear=self._vector('Vector3'),
            angular=self._vector('Vector3'),
        )
        return self._make(
            'nav_msgs/msg/Odometry',
            header=self.header('odom', ns),
            child_frame_id='base_link',
            pose=self._pose_with_covariance(T, np.zeros((3, 3))),
            twist=self._make(
                'geometry_msgs/msg/TwistWithCovariance', twist=twist, covariance=np.zeros(36)
            ),
        )

    def pose(self, ns: int, frame_id: str, T: Array) -> Any:
        """geometry_msgs/PoseStamped."""
        return self._make(
            'geometry_msgs/msg/PoseStamped', header=self.header(frame_id, ns), pose=self._pose(T)
        )

    def estimate(self, ns: int, T_map_base: Array, covariance: Array) -> Any:
        """geometry_msgs/PoseWithCovarianceStamped of a pose with covariance (3, 3) in the map."""
        pose = self._pose_with_covariance(T_map_base, covariance)
        name = 'geometry_msgs/msg/PoseWithCovarianceStamped'
        return self._make(name, header=self.header('map', ns), pose=pose)

    def transform(self, ns: int, frames: tuple[str, str], T: Array) -> Any:
        """tf2_msgs/TFMessage of one transform, from the first frame to the second."""
        transform = self._make(
            'geometry_msgs/msg/Transform',
            translation=self._vector('Vector3', T[0], T[1]),
            rotation=self._rotation(T[2]),
        )
        stamped = self._make(
            'geometry_msgs/msg/TransformStamped',
            header=self.header(frames[0], ns),
            child_frame_id=frames[1],
            transform=transform,
        )
        return self._make('tf2_msgs/msg/TFMessage', transforms=[stamped])

    def scan(self, scan: Scan) -> Any:
        """sensor_msgs/LaserScan."""
        return self._make(
            'sensor_msgs/msg/LaserScan',
            header=self.header(scan.frame or 'laser', scan.stamp_ns),
            angle_min=scan.angle_min_rad,
            angle_max=scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1),
            angle_increment=scan.angle_increment_rad,
            time_increment=scan.beam_period_s,
            scan_time=scan.scan_time_s,
            range_min=scan.range_min_m,
            range_max=scan.range_max_m,
            ranges=scan.ranges_m.astype(np.float32),
            intensities=np.zeros(0, dtype=np.float32),
        )

    def grid(self, ns: int, patch: GridPatch) -> Any:
        """nav_msgs/OccupancyGrid in the map."""
        rows, cols = patch.shape
        frame = patch.frame
        header = self.header('map', ns)
        info = self._make(
            'nav_msgs/msg/MapMetaData',
            map_load_time=header.stamp,
            resolution=frame.resolution,
            width=cols,
            height=rows,
            origin=self._pose(np.array([frame.origin_x, frame.origin_y, 0.0])),
        )
        return self._make(
            'nav_msgs/msg/OccupancyGrid', header=header, info=info, data=patch.cells.ravel()
        )

    def topology(self, ns: int, graph: TopologicalMap) -> Any:
        """thinmap_msgs/TopologicalMap in the map."""
        return self._make(
            'thinmap_msgs/msg/TopologicalMap',
            header=self.header('map', ns),
            map_id=0,
            **flat_topology(graph),
        )
