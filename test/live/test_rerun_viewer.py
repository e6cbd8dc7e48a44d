"""The viewer as a process: it writes the received messages, and ends cleanly."""

from pathlib import Path

import pytest
from geometry_msgs.msg import PoseStamped
from support.hidden_library import hide

from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.ros import messages, qos
from thinmap_ros.view import rerun_sinks

pytestmark = pytest.mark.live


def test_without_data_it_reports_so_and_ends_on_a_signal(graph):
    graph.start('rerun_viewer', spawn=False)
    graph.until(lambda: 'nothing is shown' in graph.log('rerun_viewer'), 'the warning')
    assert graph.stop('rerun_viewer') == 0


@pytest.mark.skipif(
    not rerun_sinks.is_installed(),
    reason='needs rerun, which is not installed (the extra "viewer")',
)
def test_recording_can_be_read_after_a_signal(graph, tmp_path):
    from rerun.chunk import RrdReader

    path = tmp_path / 'live.rrd'
    graph.start('rerun_viewer', recording=str(path), spawn=False)
    truth = graph.node.create_publisher(PoseStamped, 'ground_truth', qos.STREAM)
    graph.until(lambda: truth.get_subscription_count() == 1, 'the viewer listens')
    for i in range(5):
        truth.publish(messages.pose_stamped_msg([0.2 * i, 0.0, 0.0], 'map', i * SECOND_NS))
    broken = messages.pose_stamped_msg([float('nan'), 0.0, 0.0], 'map', 5 * SECOND_NS)
    truth.publish(broken)
    graph.until(
        lambda: 'ground_truth: position: nan' in graph.log('rerun_viewer'),
        'the refusal of a pose that is none',
    )
    assert graph.stop('rerun_viewer') == 0
    assert 'Traceback' not in graph.log('rerun_viewer')
    rows = sum(
        chunk.num_rows for chunk in RrdReader(path).stream() if chunk.entity_path == '/map/truth'
    )
    assert rows == 4


@pytest.mark.parametrize('parameters', [{}, {'recording': 'live.rrd', 'spawn': False}])
def test_without_rerun_the_start_ends_with_one_clear_line(
    graph, tmp_path_factory, monkeypatch, parameters
):
    hide('rerun', tmp_path_factory.mktemp('hidden'), monkeypatch)
    process = graph.start('rerun_viewer', **parameters)
    assert graph.ended(process) == 2
    assert (
        graph.log('rerun_viewer')
        .strip()
        .splitlines()[-1]
        .startswith('error: rerun is not installed')
    )
    assert not Path('live.rrd').exists()
