"""Paper 3, Fig. 10: the map of an office against its CAD data."""

from itertools import islice

import numpy as np

from thinmap_ros.evaluation import map_errors
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Table
from thinmap_ros.evaluation.slam_run import run_drive
from thinmap_ros.experiments.drives import Source, world_of
from thinmap_ros.view.plots import Plot

_QUICK_SCANS = 150


def run(source: Source) -> Outcome:
    """Map the office with EKF-SLAM/TI, and with our localizer."""
    world = world_of('office')
    samples = list(islice(source.samples('office'), _QUICK_SCANS if source.quick else None))
    done = run_drive(samples)
    ours = run_drive(samples, 'scan_matching')
    error = map_errors.map_error(done.pipeline.grid.known_area(), world)
    wheels = np.hypot(*done.errors(done.odometry)[:, :2].T)
    row = map_errors.row('office', error)
    return Outcome(
        'Map of an office',
        'SLAM paper, section 5.1, Fig. 10',
        'The office of 9.5 x 7.5 m with furniture; a Pioneer 3-AT with an LMS200 drives its tour '
        f'at 0.2 m/s ({done.path_length_m:.0f} m). Cells of 0.1 m.',
        [Table('map', map_errors.COLUMNS, [row])],
        [
            Plot(
                'fig10',
                'Paper 3, Fig. 10: (a) CAD data, (b) grid map by EKF-SLAM/TI, (c) its errors.',
                map_errors.panels(error, world),
                columns=3,
                panel_inches=(4.6, 3.9),
            )
        ],
        [
            Comparison(
                'map against CAD data',
                'similar to the accurate map',
                f'mean error of occupied cells {100 * error.cells_off_m.mean():.1f} cm, '
                f'{float(str(row[4])):.0%} within a cell; '
                f'{error.found:.0%} of all surfaces found',
                bool(error.cells_off_m.mean() < 0.1),
            ),
            Comparison(
                'position error',
                '',
                f'{done.position_error}; dead reckoning {wheels[-1]:.2f} m at the end',
                remark=f'scan matching (`slam: scan_matching`): {ours.position_error}',
            ),
        ],
    )
