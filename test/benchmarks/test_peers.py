"""Other programs on the same scans: skipped scans, and the page of what was measured."""

from pathlib import Path

import numpy as np

from benchmarks import peers_page
from benchmarks.peers.__main__ import carried, cases
from benchmarks.rows import read_records


def test_a_skipped_scan_has_the_last_pose_moved_by_the_odometry():
    odometry = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, np.pi / 2), (2.0, 0.0, 0.0)])
    found = np.array([(5.0, 5.0, np.pi / 2)] * 3 + [(9.0, 9.0, 0.0)])
    poses = carried(found, odometry, np.array([False, False, False, True]))
    np.testing.assert_allclose(poses[1], (5.0, 6.0, np.pi / 2), atol=1e-12)
    np.testing.assert_allclose(poses[2], (5.0, 6.0, np.pi), atol=1e-12)
    np.testing.assert_allclose(poses[[0, 3]], found[[0, 3]])


def test_each_run_of_a_log_is_on_the_page():
    records = read_records(Path(peers_page.__file__).parent / 'peers' / 'peers.csv')
    names = [case.name for case in cases('intel', Path('driver'), Path('shared'))]
    recorded = [record['case'] for record in records if record['case'].startswith('intel:')]
    assert recorded == names[: len(recorded)] != []
    text = peers_page.page(
        {'intel': {'name': 'intel', 'made': 'here', 'live_m': 0.04, 'final_m': 0.04}}
    )
    for record in records:
        assert f'| {" | ".join(record.values())} |\n' in text
