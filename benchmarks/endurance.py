"""Hours of a simulated robot that explores and then drives to random places.

Usage: scripts/endurance [--minutes M] -o DIR. Time waits for the nodes, so that it goes as fast as
the machine can. Writes DIR/endurance.csv, a line for every few seconds of simulated time: memory of
each node, its step time, CPU time of all nodes, scans without a pose. Ends with a verdict: growth
from the second quarter of the drive to the last one, and lost scans.

With --faults one fault after the other strikes the graph: nodes are killed or stopped, messages
dropped, repeated or late, the laser is blind or frozen, odometry and clock jump, the wheels are
blocked, the robot is carried off, the localizer loses its state, a peer changes use_sim_time. Each
is judged by the true pose of the simulator, and the map by the walls of its world. Writes
DIR/faults.json and the logs of the nodes, and prints a table and each violation; the exit code is 1
if there are any.
"""

import argparse
import os
import re
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.faults.judge import Record
from benchmarks.faults.kinds import KINDS, random_faults
from benchmarks.node_processes import NODES, Processes, processor_s, use_own_domain
from benchmarks.rows import add_record
from benchmarks.worlds import floor
from thinmap_ros.core.errors import InputError, ThinmapError
from thinmap_ros.sim.world import World
from thinmap_ros.tools import cli

_STEPS = {
    'localizer': 'localizer',
    'grid_mapper': 'map update',
    'topology_builder': 'graph update',
    'navigator': 'navigator',
}
_MEDIAN = re.compile(r'median (\d+\.\d+) ms')
_SCAN_S = 0.2
_FLAT = 1.05
_START_S = 120.0
_LAG = 5  # scans whose pose may not have arrived at the end
_DEPTH = 1000
_MIN_SAMPLES = 4  # a quarter of them is evaluated
_MINUTES = 120.0
_FAULTS_MINUTES = 5.0
_RATE = 100.0
_FAULTS_RATE = 2.0


@dataclass
class Samples:
    """Measurements of the nodes: rows of the CSV file."""

    columns: list[str]
    rows: list[list[float]] = field(default_factory=list)

    def growth(self, column: str) -> float:
        """Median of the last quarter over that of the second; NaN: not measured.

        The first quarter is for warming up.
        """
        values = np.array([row[self.columns.index(column)] for row in self.rows])
        quarter = len(values) // 4
        known = [
            part[np.isfinite(part)] for part in (values[quarter : 2 * quarter], values[-quarter:])
        ]
        if not all(part.size for part in known):
            return np.nan
        return float(np.median(known[1]) / np.median(known[0]))


class Driver:
    """A client of the nodes: drives the robot about, and counts the poses of its scans."""

    def __init__(self, world: World, seed: int) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseWithCovarianceStamped
        from rclpy.qos import QoSProfile
        from rclpy.signals import SignalHandlerOptions

        from benchmarks.goal_client import GoalClient, Interruption
        from thinmap_ros.ros import messages

        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._interruption = Interruption()
        self._rclpy = rclpy
        self._messages = messages
        self._node = rclpy.create_node('endurance')
        self.client = GoalClient(self._node, world, seed)
        self.poses = 0
        self.first_s = 0.0
        self.simulated_s = 0.0
        self.step_ms: dict[str, float] = {}
        deep = QoSProfile(depth=_DEPTH)
        self._node.create_subscription(PoseWithCovarianceStamped, 'pose', self._on_pose, deep)
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, deep)

    def spin(self) -> None:
        """Process received messages, and send the next goal if the robot is idle.

        Raises KeyboardInterrupt after Ctrl-C.
        """
        self._rclpy.spin_once(self._node, timeout_sec=0.02)
        self._interruption.check()
        if self.poses:
            self.client.step()

    def lost(self) -> int:
        """Scans without a pose since the first received one."""
        return max(round((self.simulated_s - self.first_s) / _SCAN_S) + 1 - self.poses, 0)

    def close(self) -> None:
        """Destroy the client."""
        self._node.destroy_node()
        self._rclpy.shutdown()

    def _on_pose(self, message: Any) -> None:
        stamp_s = self._messages.stamp_ns(message.header.stamp) / 1e9
        self.first_s = self.first_s if self.poses else stamp_s
        self.poses += 1
        self.simulated_s = max(self.simulated_s, stamp_s)

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            name = status.name.partition(':')[0]
            for pair in status.values:
                median = _MEDIAN.match(pair.value)
                if median and pair.key == f'{_STEPS.get(name)}: step time':
                    self.step_ms[name] = float(median[1])


def start_all(nodes: Processes, world: Path, at: np.ndarray, rate: float, seed: int) -> None:
    """Start nodes and simulator."""
    nodes.start_nodes(at)
    parameters = {
        'world': world,
        'start': ','.join(map(str, at.tolist())),
        'real_time_factor': rate,
        'seed': seed,
        'lockstep': 'local_topology',
        'wait_for_subscribers': 3,
    }
    nodes.start('sim', parameters)


def measure(driver: Driver, nodes: Processes, arguments: argparse.Namespace, path: Path) -> Samples:
    """Drive for a duration, and record measurements of the nodes.

    Raises ThinmapError if a node exits, or no pose arrives.
    """
    columns = [
        'simulated_s',
        'wall_s',
        *(f'{n}_mb' for n in NODES),
        *(f'{n}_ms' for n in _STEPS),
        'cpu_s',
        'lost',
    ]
    samples = Samples(columns)
    begun = time.monotonic()
    every_s = 60.0 * arguments.minutes / arguments.samples
    path.unlink(missing_ok=True)
    while driver.simulated_s < 60.0 * arguments.minutes:
        driver.spin()
        for text in nodes.ended().values():
            raise ThinmapError(text)
        if not driver.poses and time.monotonic() - begun > _START_S:
            raise ThinmapError(f'no pose came in {_START_S:.0f} s')
        if driver.simulated_s >= every_s * (len(samples.rows) + 1):
            row = sample(driver, nodes, time.monotonic() - begun)
            samples.rows.append(row)
            texts = (f'{value:.6g}' for value in row)
            add_record(path, dict(zip(columns, texts, strict=True)))
    return samples


def sample(driver: Driver, nodes: Processes, wall_s: float) -> list[float]:
    """A row: private memory of each node, MB; median step times, ms; CPU time of all nodes, s."""
    processes = [nodes.running[name] for name in NODES]
    memory = [process.memory_full_info().uss / 1e6 for process in processes]
    steps = [driver.step_ms.get(name, np.nan) for name in _STEPS]
    lost = max(driver.lost() - _LAG, 0)
    return [driver.simulated_s, wall_s, *memory, *steps, processor_s(processes), lost]


def verdict(samples: Samples, driver: Driver) -> bool:
    """Print growth and losses; returns whether nothing grew and no scan was lost."""
    memory = {name: samples.growth(f'{name}_mb') for name in NODES}
    steps = {name: samples.growth(f'{name}_ms') for name in _STEPS}
    for what, found in (('memory', memory), ('step time', steps)):
        print(
            f'{what}, last quarter over second: '
            + ', '.join(f'{n} {v:.3f}' for n, v in found.items())
        )
    lost = samples.rows[-1][-1]
    flat = max(memory.values()) <= _FLAT
    good = flat and lost == 0
    print(
        f'{"GOOD" if good else "BAD"}: {samples.rows[-1][0] / 60.0:.1f} min simulated, '
        f'{driver.client.reached} of {driver.client.goals} places reached; '
        f'memory {"flat within" if flat else "NOT flat within"} 5 % '
        f'(most: {max(memory.values()):.3f}), '
        f'step time at most {np.nanmax(list(steps.values())):.3f} of what it was, '
        f'{lost:.0f} of {driver.poses + lost:.0f} scans lost'
    )
    return good


def _drive(arguments: argparse.Namespace, path: Path, world: World) -> bool:
    """Drive, measure and print the verdict; returns whether it is good."""
    driver = Driver(world, arguments.seed)
    rate = arguments.rate or _RATE
    with TemporaryDirectory() as folder:
        nodes = Processes(Path(folder))
        try:
            start_all(nodes, path, world.start, rate, arguments.seed)
            samples = measure(driver, nodes, arguments, arguments.out / 'endurance.csv')
        finally:
            nodes.close()
            driver.close()
    return verdict(samples, driver)


def _drive_with_faults(arguments: argparse.Namespace, path: Path, world: World) -> bool:
    """Drive under faults and print the table; returns whether there was no violation."""
    from benchmarks.faults import judge
    from benchmarks.faults.run import Setting, drive

    # A node that is killed while it holds the lock of a shared memory port would block the others.
    os.environ['FASTDDS_BUILTIN_TRANSPORTS'] = 'UDPv4'
    rate = arguments.rate or _FAULTS_RATE
    setting = Setting(
        path=path.resolve(),
        world=world,
        seconds=60.0 * arguments.minutes,
        rate=rate,
        seed=arguments.seed,
        out=arguments.out.resolve(),
        faults=random_faults(arguments.seed, arguments.only),
    )
    records: list[Record] = []
    values = {'seed': arguments.seed, 'minutes': arguments.minutes, 'world': world.name}

    def add(record: Record) -> None:
        records.append(record)
        print(judge.line(record), flush=True)
        judge.write_json(arguments.out / 'faults.json', records, values)

    try:
        drive(setting, add)
    finally:
        print(judge.table(records))
    return not any(record.violations() for record in records)


def work(arguments: argparse.Namespace) -> None:
    """Do what the command line asks for; ends the program with 1 where the result is bad."""
    if arguments.minutes is None:
        arguments.minutes = _FAULTS_MINUTES if arguments.faults else _MINUTES
    if not arguments.minutes > 0.0 or arguments.samples < _MIN_SAMPLES:
        given = f'--minutes {arguments.minutes}, --samples {arguments.samples}'
        raise InputError(
            f'{given}: expected more than 0 minutes and at least {_MIN_SAMPLES} samples'
        )
    there = floor(arguments.world)
    arguments.out.mkdir(parents=True, exist_ok=True)
    run = _drive_with_faults if arguments.faults else _drive
    if not run(arguments, there.path, there.world):
        sys.exit(1)


def parser() -> argparse.ArgumentParser:
    """Options of the command line."""
    made = argparse.ArgumentParser(prog='endurance', description=__doc__)
    made.add_argument(
        '--minutes',
        type=float,
        help=f'simulated minutes (default {_MINUTES:g}; with --faults {_FAULTS_MINUTES:g})',
    )
    made.add_argument(
        '--rate',
        type=float,
        help='simulated seconds a second at most '
        f'(default {_RATE:g}; with --faults {_FAULTS_RATE:g})',
    )
    made.add_argument(
        '--world', default='room_10x10', help='world or map YAML file, or a world of the package'
    )
    made.add_argument('--seed', type=int, default=0, help='decides places and noise (default 0)')
    made.add_argument(
        '--samples', type=int, default=240, help='lines of the CSV file (default 240)'
    )
    made.add_argument('--faults', action='store_true', help='drive under random faults')
    made.add_argument(
        '--only',
        nargs='+',
        choices=sorted(KINDS),
        metavar='FAULT',
        default=[],
        help=f'with --faults: these kinds only, of {", ".join(sorted(KINDS))}',
    )
    made.add_argument(
        '-o', '--out', type=Path, default=Path('out/endurance'), help='folder (out/endurance)'
    )
    return made


def main() -> None:
    """Run the program."""

    def work_alone(arguments: argparse.Namespace) -> None:
        use_own_domain()
        work(arguments)

    cli.run(work_alone, parser())


if __name__ == '__main__':
    main()
