"""Simulated robots that explore one world together, each with all of its nodes as processes.

Between their explorers is a radio, which may lose messages and be switched off. Their starts are
known to map_joiner.
"""

import signal

import numpy as np
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from std_msgs.msg import UInt32

from thinmap_msgs.msg import (
    ExplorationStatus,
    JoinStatus,
    MapTiles,
    TeamClaim,
    TileRequest,
)
from thinmap_ros.ros import messages, qos

MAPPING = ('localizer', 'grid_mapper', 'topology_builder')
DECIDING = ('explorer', 'navigator')
# Subscribers of the scans of a robot: localizer, explorer and navigator.
_SCAN_LISTENERS = 3
_KINDS = {'claims': TeamClaim, 'tiles': MapTiles, 'tile_requests': TileRequest}
_PROFILES = {'claims': qos.SENSOR, 'tiles': qos.TILES, 'tile_requests': qos.STREAM}


class Radio:
    """Carries what robots send each other; each has /team/... in its namespace.

    is_on: whether it carries anything. What is lost is not sent again, unlike by DDS.
    """

    def __init__(self, graph, names, loss, seed=0):
        """loss: share of messages that do not arrive."""
        self.is_on = True
        self.carried = dict.fromkeys(_KINDS, 0)
        self._loss = loss
        self._rng = np.random.default_rng(seed)
        self._outputs: dict[tuple[str, str], Publisher] = {}
        for name in names:
            for kind, message_type in _KINDS.items():
                topic = f'{name}/team/{kind}'
                profile = _PROFILES[kind]
                self._outputs[name, kind] = graph.node.create_publisher(
                    message_type, topic, profile
                )
                graph.node.create_subscription(
                    message_type, topic, self._carry_from(name, kind), profile
                )

    def _carry_from(self, sender, kind):
        def carry(message):
            # A request names the robot that it is for, all others that which sends them. What was
            # carried here is received again, and is of another robot.
            is_request = kind == 'tile_requests'
            if (message.robot == sender) == is_request or not self.is_on:
                return
            for (receiver, to), output in self._outputs.items():
                is_for_it = receiver == message.robot if is_request else receiver != sender
                if to == kind and is_for_it and self._rng.random() >= self._loss:
                    self.carried[kind] += 1
                    output.publish(message)

        return carry


class DrivingTeam:
    """Robots in one world, from starts (3,); all have the map frame of the world.

    loss: share of the messages between them that do not arrive; None: no radio, they hear each
    other directly. parameters: of explorer, navigator and mapper.
    """

    def __init__(self, graph, world, starts, loss=None, rate=10.0, **parameters):
        self.graph = graph
        self.names = [f'/robot{number}' for number in range(1, len(starts) + 1)]
        self.radio = None if loss is None else Radio(graph, self.names, loss)
        self.now_s = 0.0
        self.statuses = self._hear('exploration_status', ExplorationStatus)
        self._contacts = self._hear('collisions', UInt32)
        self._joined = graph.heard('/join_status', JoinStatus, qos.LATCHED)
        graph.node.create_subscription(Clock, '/clock', self._on_clock, qos.SENSOR)
        for name, start in zip(self.names, starts, strict=True):
            self._start_robot(name, start, parameters)
        graph.start(
            'map_joiner',
            use_sim_time=True,
            known_init_poses=True,
            **{f'{name}/map_merge/init_pose_x': 0.0 for name in self.names},
        )
        graph.start(
            'sim',
            world=str(world),
            robots=len(starts),
            starts='; '.join(','.join(map(str, start.tolist())) for start in starts),
            real_time_factor=rate,
            lockstep='local_topology',
            wait_for_subscribers=_SCAN_LISTENERS,
        )

    def _hear(self, topic, kind):
        return {name: self.graph.heard(f'{name}/{topic}', kind, qos.LATCHED) for name in self.names}

    def _on_clock(self, message):
        self.now_s = messages.stamp_ns(message.clock) / 1e9

    def _start_robot(self, name, start, parameters):
        remap = [f'__ns:={name}', '/tf:=tf', '/tf_static:=tf_static']
        if self.radio is not None:
            remap += [f'/team/{kind}:={name}/team/{kind}' for kind in _KINDS]
        x, y, yaw = (float(number) for number in start)
        pose = {'initial_x_m': x, 'initial_y_m': y, 'initial_yaw_rad': yaw}
        for label, nodes, own in (
            ('mapping', MAPPING, pose),
            ('deciding', DECIDING, {'autostart_exploration': True}),
        ):
            common = {key: value for key, value in parameters.items() if label == 'deciding'}
            self.graph.start(
                'thinmap',
                remap=tuple(remap),
                arguments=nodes,
                label=f'{name.strip("/")}_{label}',
                use_sim_time=True,
                team=True,
                **own,
                **common,
            )

    def kill(self, name):
        """Kill the explorer and navigator of a robot."""
        self.graph.stop(f'{name.strip("/")}_deciding', signal.SIGKILL)

    def until_time(self, seconds):
        self.graph.until(lambda: self.now_s >= seconds, f'time {seconds} s')

    def until_joined(self):
        def is_joined():
            maps = self._joined[-1].maps if self._joined else []
            return sum(each.is_joined for each in maps) == len(self.names)

        self.graph.until(is_joined, 'all maps are joined')

    def status(self, name):
        """Newest status of the exploration of a robot; None before."""
        return self.statuses[name][-1] if self.statuses[name] else None

    def is_finished(self, name):
        status = self.status(name)
        return status is not None and status.state == ExplorationStatus.FINISHED

    def until_finished(self, names=None):
        """Until robots have nothing left to explore."""
        for name in names or self.names:
            self.graph.until(lambda name=name: self.is_finished(name), f'{name} is finished')

    def contacts(self):
        """Number of contacts of all robots."""
        return sum(heard[-1].data for heard in self._contacts.values() if heard)
