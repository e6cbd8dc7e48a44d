"""Records the drives of the experiments: a bag with sensors, ground truth and outputs for each."""

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.grid.occupancy import PAPER_GRID
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import Estimate
from thinmap_ros.experiments.drives import RECIPES, TRUTH_TOPIC, Source
from thinmap_ros.files import package_data
from thinmap_ros.files.safe import write_text
from thinmap_ros.logs.bag_writer import BagObjects, BagWriter
from thinmap_ros.pipeline import Pipeline, PipelineConfig
from thinmap_ros.sim.drives import DriveSample
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, add_out, out_folder

_MAP_EVERY = 300  # scans: a minute
_TYPES = {
    '/scan': 'sensor_msgs/msg/LaserScan',
    '/odom': 'nav_msgs/msg/Odometry',
    '/tf': 'tf2_msgs/msg/TFMessage',
    '/tf_static': 'tf2_msgs/msg/TFMessage',
    TRUTH_TOPIC: 'geometry_msgs/msg/PoseStamped',
    '/pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    '/map': 'nav_msgs/msg/OccupancyGrid',
    '/topology': 'thinmap_msgs/msg/TopologicalMap',
}


class _BagRecorder:
    """Writes a bag; messages with equal stamps are a nanosecond apart in log time."""

    def __init__(self, writer: BagWriter) -> None:
        self._writer = writer
        self._objects = BagObjects(writer.typestore.types)
        self._log_ns = 0

    def _write(self, topic: str, stamp_ns: int, message: object) -> None:
        self._log_ns = max(stamp_ns, self._log_ns + 1)
        self._writer.write(topic, _TYPES[topic], self._log_ns, message)

    def write_laser_mount(self, sample: DriveSample) -> None:
        """Write the pose of the laser."""
        ns = sample.scan.stamp_ns
        made = self._objects
        self._write(
            '/tf_static', ns, made.transform(ns, ('base_link', 'laser'), sample.scan.T_base_laser)
        )

    def write_sensors(self, sample: DriveSample) -> None:
        """Write scan, odometry and true pose of a sample."""
        ns = sample.scan.stamp_ns
        made = self._objects
        self._write(TRUTH_TOPIC, ns, made.pose(ns, 'map', sample.T_world_base))
        self._write('/odom', ns, made.odometry(ns, sample.T_odom_base))
        self._write('/tf', ns, made.transform(ns, ('odom', 'base_link'), sample.T_odom_base))
        self._write('/scan', ns, made.scan(sample.scan))

    def write_estimate(self, ns: int, estimate: Estimate) -> None:
        """Write the estimate of the localizer."""
        made = self._objects
        self._write('/pose', ns, made.estimate(ns, estimate.T_map_base, estimate.covariance))
        self._write('/tf', ns, made.transform(ns, ('map', 'odom'), estimate.T_map_odom))

    def write_maps(self, ns: int, pipeline: Pipeline) -> None:
        """Write the present map and graph."""
        self._write('/map', ns, self._objects.grid(ns, pipeline.grid.known_area()))
        self._write('/topology', ns, self._objects.topology(ns, pipeline.topology.map))


def record(path: Path, samples: Iterable[DriveSample], localized: bool) -> int:
    """Write the bag of a drive; returns the number of scans.

    localized: by the localizer, else by ground truth.
    """
    definitions = package_data.message_definitions('thinmap_msgs')
    scans = 0
    pipeline = None
    with BagWriter(path, definitions=definitions, compressed=True) as writer:
        recording = _BagRecorder(writer)
        for sample in samples:
            if pipeline is None:
                pipeline, truth = _pipeline(sample, localized)
                recording.write_laser_mount(sample)
            truth[:] = [sample.T_world_base]
            recording.write_sensors(sample)
            recording.write_estimate(
                sample.scan.stamp_ns, pipeline.step(sample.scan, sample.T_odom_base).estimate
            )
            scans += 1
            if scans % _MAP_EVERY == 0:
                recording.write_maps(sample.scan.stamp_ns, pipeline)
        if pipeline is not None and scans % _MAP_EVERY:
            recording.write_maps(sample.scan.stamp_ns, pipeline)
    return scans


def _pipeline(first: DriveSample, localized: bool) -> tuple[Pipeline, list[Array]]:
    """A pipeline for a drive from this sample, and the list for the true pose of each scan."""
    x, y, yaw = (float(number) for number in first.T_world_base)
    localizer = LocalizerConfig(initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw)
    config = PipelineConfig(localizer=localizer, grid=PAPER_GRID)
    truth: list[Array] = []

    def known(scan: object, T_odom_base: Array) -> Estimate:
        return Estimate(truth[0], np.zeros((3, 3)), se2.compose(truth[0], se2.invert(T_odom_base)))

    return Pipeline(config, None if localized else known), truth


def _about(name: str, seed: int, scans: int, seconds: float, localized: bool) -> str:
    recipe = RECIPES[name]
    poses = 'by the localizer' if localized else 'the true ones'
    return (
        f'{name}.mcap\n\n'
        f'A simulated Pioneer {recipe.robot.upper()} with an LMS200 (181 beams, 8 m, 5 Hz),\n'
        f'in worlds/{recipe.world}.yaml, {recipe.how}.\n'
        f'Seed {seed}; {scans} scans in {seconds:.1f} s.\n\n'
        f'Topics: /scan /odom /tf /tf_static {TRUTH_TOPIC}, '
        f'and as outputs /pose (poses {poses}), and once a minute\n'
        '/map and /topology. MCAP with zstd. Made by: scripts/record_bags\n'
    )


def _work(arguments: argparse.Namespace) -> None:
    if unknown := set(arguments.names) - set(RECIPES):
        raise InputError(f'drive {quoted(min(unknown))}: expected some of {", ".join(RECIPES)}')
    out = out_folder(arguments.out, 'bags')
    for name in arguments.names or RECIPES:
        path = out / f'{name}.mcap'
        samples = list(Source(arguments.seed).samples(name))
        localized = RECIPES[name].localized
        scans = record(path, samples, localized)
        seconds = (samples[-1].scan.stamp_ns - samples[0].scan.stamp_ns) / 1e9
        write_text(out / f'{name}.txt', _about(name, arguments.seed, scans, seconds, localized))
        print(f'{path}: {scans} scans, {path.stat().st_size / 1e6:.2f} MB', flush=True)


def main() -> None:
    """Run the program."""
    parser = Parser('record_bags', __doc__)
    parser.add_argument(
        'names', nargs='*', help=f'which drives: some of {", ".join(RECIPES)} (default: all)'
    )
    add_out(parser, 'out/bags')
    parser.add_argument('--seed', type=int, default=0, help='decides all noise (default 0)')
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
