"""Nearly valid messages, with up to three errors.

As published by faulty drivers and nodes.
"""

import math
import zlib
from array import array

import hypothesis
import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import LaserScan

from thinmap_msgs.msg import (
    LocalGrid,
    LocalizedScan,
    MapTiles,
    ProbabilityGrid,
    SettledPlace,
    TeamClaim,
    TopologicalMap,
)
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.team import MAX_SETTLED
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.shared import JoinedMaps, TileSender
from thinmap_ros.core.stage import Destination
from thinmap_ros.core.topology.graph import FIELDS, Edge, Node, NodeKind, topology_from_msg
from thinmap_ros.core.topology.graph import TopologicalMap as Graph
from thinmap_ros.ros import messages
from thinmap_ros.ros.localized_scan import localized_scan_from_msg
from thinmap_ros.ros.team import claim_from_msg, tiles_from_msg, tiles_msg

STRANGE = st.sampled_from(
    [
        math.nan,
        math.inf,
        -math.inf,
        0.0,
        -0.0,
        -1.0,
        1e-300,
        1e-30,
        1e9,
        -1e9,
        1e30,
        1e300,
        -1e300,
        3.0,
        400.0,
    ]
)
STRANGE_32 = st.sampled_from(
    [math.nan, math.inf, -math.inf, 0.0, -0.0, -1.0, 1e-30, 1e-3, 1e9, 1e30, -1e30, 3.0]
)
NAMES = st.sampled_from(
    ['', 'laser', 'map', '/laser', 'nowhere', 'x' * 300, 'a\nb\tc', '\u5730\u56f3', '..', ' ']
)
PERIOD_NS = 100_000_000


def stamped(draw, message, ns):
    message.header.stamp.sec = ns // 10**9
    message.header.stamp.nanosec = ns % 10**9
    if draw(st.integers(0, 9)) == 0:
        message.header.stamp.sec = draw(st.sampled_from([0, -1, -(2**31), 2**31 - 1, 4_000_000, 1]))
        message.header.stamp.nanosec = draw(st.sampled_from([0, 10**9, 2**32 - 1]))
    return message


def changed(draw, setters):
    """Apply up to three of the changes; often none."""
    for setter in (
        draw(st.lists(st.sampled_from(setters), max_size=3)) if draw(st.booleans()) else []
    ):
        setter()


@st.composite
def scans(draw, ns=10**9):
    message = stamped(
        draw, LaserScan(angle_min=-1.5, angle_max=1.5, range_min=0.05, range_max=8.0), ns
    )
    message.header.frame_id = 'laser'
    message.angle_increment = 3.0 / 60.0
    ranges = np.full(61, 2.0, dtype=np.float32)

    def some_ranges():
        ranges[draw(st.integers(0, 60)) :] = draw(STRANGE_32)

    def length():
        nonlocal ranges
        ranges = np.resize(ranges, draw(st.sampled_from([0, 1, 2, 7, 1000, 20_000])))

    def number(name):
        return lambda: setattr(message, name, draw(STRANGE_32))

    def frame():
        message.header.frame_id = draw(NAMES)

    names = (
        'angle_min',
        'angle_max',
        'angle_increment',
        'range_min',
        'range_max',
        'time_increment',
        'scan_time',
    )
    changed(draw, [some_ranges, length, frame, *map(number, names)])
    values = array('f')
    values.frombytes(ranges.tobytes())
    message.ranges = values
    return message


def pose_setters(draw, pose):
    def position(name):
        return lambda: setattr(pose.position, name, draw(STRANGE))

    def turn(name):
        return lambda: setattr(pose.orientation, name, draw(STRANGE))

    return [*map(position, 'xyz'), *map(turn, 'xyzw')]


@st.composite
def odometries(draw, ns=10**9):
    message = stamped(draw, Odometry(child_frame_id='base_link'), ns)
    message.header.frame_id = 'odom'
    message.pose.pose.orientation.w = 1.0

    def covariance():
        message.pose.covariance[draw(st.integers(0, 35))] = draw(STRANGE)

    def frames():
        message.header.frame_id = draw(NAMES)
        message.child_frame_id = draw(NAMES)

    changed(draw, [covariance, frames, *pose_setters(draw, message.pose.pose)])
    return message


@st.composite
def poses(draw, ns=10**9):
    message = stamped(draw, PoseWithCovarianceStamped(), ns)
    message.header.frame_id = 'map'
    message.pose.pose.orientation.w = 1.0

    def covariance():
        message.pose.covariance[draw(st.sampled_from([0, 1, 5, 6, 7, 11, 30, 35]))] = draw(STRANGE)

    changed(draw, [covariance, *pose_setters(draw, message.pose.pose)])
    return message


@st.composite
def grids(draw, ns=10**9):
    message = stamped(draw, OccupancyGrid(), ns)
    message.header.frame_id = 'map'
    info = message.info
    info.resolution = 0.1
    info.width = 40
    info.height = 40
    info.origin.position.x = -2.0
    info.origin.position.y = -2.0
    info.origin.orientation.w = 1.0
    cells = np.zeros((40, 40), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100

    def cell():
        cells[draw(st.integers(0, 39))] = draw(st.integers(-128, 127))

    def size():
        info.width = draw(st.sampled_from([0, 1, 39, 41, 1600, 2**32 - 1]))

    def resolution():
        info.resolution = draw(STRANGE_32)

    def flat():
        info.width = 1600
        info.height = 1

    changed(draw, [cell, size, resolution, flat, *pose_setters(draw, info.origin)])
    data = array('b')
    data.frombytes(cells.tobytes())
    message.data = data
    return message


@st.composite
def topologies(draw, ns=10**9):
    nodes = [Node(i, NodeKind.END, float(i - 1), 0.0, 0.5) for i in range(1, 4)]
    path = np.array([[0.0, 0.0], [1.0, 0.0]])
    graph = Graph(nodes, [Edge(9, 1, 2, path, 1.0, 0.5)])
    message = stamped(draw, messages.topology_msg(graph, 'map', ns), ns)

    def anywhere(name):
        values = getattr(message, name)
        return values, draw(st.integers(0, max(len(values) - 1, 0)))

    def number(name, strange):
        def change():
            values, place = anywhere(name)
            if values:
                values[place] = draw(strange)

        return change

    def size(name):
        def change():
            values, place = anywhere(name)
            if draw(st.booleans()):
                values.insert(place, 1)
            elif values:
                values.pop(place)

        return change

    whole = st.sampled_from([0, 1, 2, 9, 255])
    floats = {'node_xy': STRANGE, 'node_clearance_m': STRANGE_32, 'edge_length_m': STRANGE_32}
    floats |= {'edge_clearance_m': STRANGE_32, 'edge_xy': STRANGE_32}
    numbers = [number(name, floats.get(name, whole)) for name in FIELDS]
    changed(draw, [*numbers, *(size(name) for name in FIELDS)])
    return message


@st.composite
def probability_grids(draw, ns=10**9):
    grid = draw(grids(ns))
    return ProbabilityGrid(header=grid.header, info=grid.info, data=grid.data)


@st.composite
def localized_scans(draw, ns=10**9):
    pose = draw(poses(ns))
    message = LocalizedScan(header=pose.header, scan=draw(scans(ns)), pose=pose.pose)
    message.max_range_m = 8.0
    message.laser_pose.orientation.w = 1.0

    def max_range():
        message.max_range_m = draw(STRANGE)

    def correction():
        message.correction_stamp.sec = draw(st.sampled_from([-1, 0, 999, 2**31 - 1]))

    def state():
        message.status.state = draw(st.integers(0, 255))

    changed(draw, [max_range, correction, state, *pose_setters(draw, message.laser_pose)])
    return message


@st.composite
def local_grids(draw, ns=10**9):
    grid = draw(probability_grids(ns))
    return LocalGrid(header=grid.header, grid=grid, localized=draw(localized_scans(ns)))


@st.composite
def claims(draw, ns=10**9):
    message = stamped(draw, TeamClaim(robot='/a', session=1, state=1, remaining_s=2.0), ns)
    message.settled = [SettledPlace(x=1.0, y=2.0, visits=1)] * 2

    def number(part, name):
        return lambda: setattr(getattr(message, part), name, draw(STRANGE_32))

    def own(name):
        return lambda: setattr(message, name, draw(STRANGE_32))

    def place():
        if message.settled:
            message.settled[0].x = draw(STRANGE_32)

    def count():
        message.settled *= draw(st.sampled_from([0, 3, 5, 100]))

    def name():
        message.robot = draw(NAMES)

    def state():
        message.state = draw(st.integers(0, 255))

    points = [number(part, axis) for part in ('goal', 'frontier') for axis in 'xy']
    points += pose_setters(draw, message.pose)
    changed(draw, [*points, *map(own, ('v', 'w', 'remaining_s')), place, count, name, state])
    return message


@st.composite
def tiles(draw, ns=10**9):
    frame = GridFrame(0.0, 0.0, 0.1)
    sender = TileSender(frame)
    sender.update(GridPatch(frame, np.zeros((40, 40), dtype=np.int8)))
    head = messages.header('map', ns)
    message = stamped(draw, tiles_msg(head, '/a', 1, sender.changes_after(0)), ns)

    def name():
        message.robot = draw(NAMES)

    def cut():
        del message.data[draw(st.integers(0, len(message.data))) :]

    def byte():
        if message.data:
            message.data[draw(st.integers(0, len(message.data) - 1))] = draw(st.integers(0, 255))

    def plain():
        data = bytearray(zlib.decompress(sender.changes_after(0).encode()))
        data[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
        message.data = array('B', zlib.compress(bytes(data)))

    def layout():
        message.layout = draw(st.integers(0, 255))

    changed(draw, [name, cut, byte, plain, layout])
    return message


STRATEGIES = {
    MapTiles: tiles,
    TeamClaim: claims,
    LaserScan: scans,
    Odometry: odometries,
    PoseWithCovarianceStamped: poses,
    OccupancyGrid: grids,
    ProbabilityGrid: probability_grids,
    LocalizedScan: localized_scans,
    LocalGrid: local_grids,
    TopologicalMap: topologies,
}


def check_scan(message):
    scan = messages.scan_from_msg(message, np.zeros(3))
    assert np.isfinite(scan.points_base()).all() and np.isfinite(scan.angles_rad).all()
    assert scan.ranges_m.size == len(message.ranges) > 0 and scan.stamp_ns >= 0


def check_odometry(message):
    assert messages.stamp_ns(message.header.stamp) >= 0
    assert np.isfinite(messages.pose_from_msg(message.pose.pose)).all()


def check_pose(message):
    check_odometry(message)
    covariance = messages.covariance_from_msg(message)
    assert np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance).min() > -1e-8


def check_grid(message):
    patch = messages.grid_from_msg(message)
    assert (
        patch.cells.size >= len(message.data)
        and patch.cells.min() >= -1
        and patch.cells.max() <= 100
    )
    assert np.isfinite(patch.frame.as_array()).all() and patch.frame.resolution > 0.0


def check_localized_scan(message):
    found = localized_scan_from_msg(message)
    assert np.isfinite(found.scan.points_base()).all() and np.isfinite(found.T_map_base).all()
    assert found.corrected_ns >= 0 and found.destination in Destination


def check_local_grid(message):
    check_grid(message.grid)
    check_localized_scan(message.localized)


def check_topology(message):
    found = topology_from_msg(message)
    assert list(found.nodes) == list(message.node_ids)
    assert list(found.edges) == list(message.edge_ids)
    assert all(math.isfinite(node.x + node.y + node.clearance_m) for node in found.nodes.values())
    assert all(
        np.isfinite(edge.path).all() and {edge.a, edge.b} <= found.nodes.keys()
        for edge in found.edges.values()
    )


def check_claim(message):
    found = claim_from_msg(message)
    assert np.isfinite(found.claim.pose).all() and np.isfinite(found.claim.remaining_s)
    assert found.claim.place is None or np.isfinite(found.claim.place).all()
    assert len(found.claim.settled) <= MAX_SETTLED and found.claim.robot


def check_tiles(message):
    received = JoinedMaps()
    received.place({message.robot: np.zeros(3)})
    received.add(message.robot, message.session, tiles_from_msg(message))
    own = GridPatch(GridFrame(0.03, 0.0, 0.1), np.full((1, 1), -1, dtype=np.int8))
    cells = received.completed(own).cells
    assert cells.min() >= -1 and cells.max() <= 100


CHECKS = {
    MapTiles: check_tiles,
    TeamClaim: check_claim,
    LaserScan: check_scan,
    Odometry: check_odometry,
    PoseWithCovarianceStamped: check_pose,
    OccupancyGrid: check_grid,
    ProbabilityGrid: check_grid,
    LocalizedScan: check_localized_scan,
    LocalGrid: check_local_grid,
    TopologicalMap: check_topology,
}


def made(kind, count, seed=None):
    """A number of messages of a type, reproducible by a seed.

    Stamps increase by 0.1 s.
    """
    messages = []

    @settings(
        max_examples=count,
        database=None,
        derandomize=seed is None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def make(data):
        ns = 10**12 + len(messages) * PERIOD_NS
        messages.append(data.draw(STRATEGIES[kind](ns)))

    make = make if seed is None else hypothesis.seed(seed)(make)
    make()
    # Hypothesis ends early when it has exhausted all examples: then they are repeated.
    while len(messages) < count:
        make()
    return messages[:count]


def numbers(message):
    """All floating point numbers of a message, but those of scans in it (REP 117)."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if isinstance(value, LaserScan):
            continue
        if hasattr(value, 'get_fields_and_field_types'):
            yield from numbers(value)
        elif 'float' in kind or 'double' in kind:
            yield from np.ravel(value).tolist()
        elif isinstance(value, list):
            for part in value:
                if hasattr(part, 'get_fields_and_field_types'):
                    yield from numbers(part)


def is_rejected(message):
    """Whether its conversion refuses it, in one line; else the values are sound."""
    try:
        CHECKS[type(message)](message)
    except InputError as error:
        assert '\n' not in str(error) and len(str(error)) < 500
        return True
    return False


def is_plain(message):
    """Whether a message is without the strange values that are put into sound ones."""
    if isinstance(message, LaserScan):
        return (
            message.header.frame_id == 'laser'
            and list(message.ranges) == 61 * [2.0]
            and message.range_max == 8.0
        )
    if isinstance(message, LocalizedScan):
        return is_plain(message.scan) and message.pose.pose.position.x == 0.0
    if isinstance(message, LocalGrid):
        return is_plain(message.grid) and is_plain(message.localized)
    if isinstance(message, OccupancyGrid | ProbabilityGrid):
        return (
            message.info.width == 40
            and abs(message.info.origin.position.x + 2.0) < 1e-9
            and message.data[41] == 0
        )
    if isinstance(message, TopologicalMap | TeamClaim | MapTiles):
        return True
    return message.pose.pose.position.x == 0.0 and message.pose.pose.position.y == 0.0
