"""The views for RViz and Foxglove name topics of the nodes, with their types."""

import json
import re

import pytest
import yaml
from support.node_list import ROOT

RVIZ = yaml.safe_load((ROOT / 'config' / 'thinmap.rviz').read_text())['Visualization Manager']
FOXGLOVE = json.loads((ROOT / 'config' / 'thinmap_foxglove.json').read_text())
TYPES = {
    'Map': 'nav_msgs/msg/OccupancyGrid',
    'LaserScan': 'sensor_msgs/msg/LaserScan',
    'MarkerArray': 'visualization_msgs/msg/MarkerArray',
    'Path': 'nav_msgs/msg/Path',
    'PoseWithCovariance': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'Pose': 'geometry_msgs/msg/PoseStamped',
    'SetInitialPose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'SetGoal': 'geometry_msgs/msg/PoseStamped',
}


def reference(heading):
    """Topics of all nodes by name, with type and quality, that they publish or subscribe to."""
    found = {}
    table = ''
    for line in (ROOT / 'docs' / 'reference' / 'nodes.md').read_text().splitlines():
        row = re.fullmatch(r'\| `([\w/~]+)` \| `([\w/]+)` \| ([\w ,]+) \|', line)
        if line.startswith('| '):
            table = line if row is None and not line.startswith('|---') else table
        if row and table.startswith(f'| {heading}'):
            found[row[1].lstrip('/')] = (row[2], row[3])
    return found


PUBLISHED = reference('Publishes')
SUBSCRIBED = reference('Subscribes to')


def entries():
    for entry in [*RVIZ['Displays'], *RVIZ['Tools']]:
        if 'Topic' in entry:
            kind = entry['Class'].split('/')[-1]
            yield pytest.param(kind, entry['Topic'], id=entry['Topic']['Value'])


@pytest.mark.parametrize(('kind', 'topic'), entries())
def test_rviz_shows_topics_with_their_types(kind, topic):
    topics = SUBSCRIBED if kind.startswith('Set') else PUBLISHED
    known, quality = topics[topic['Value'].lstrip('/')]
    assert known == TYPES[kind]
    if topics is PUBLISHED:
        # RViz must not request more than is offered.
        assert topic['Durability Policy'] == 'Volatile' or 'latched' in quality
        assert topic['Reliability Policy'] == 'Best Effort' or 'reliable' in quality


def test_foxglove_shows_the_same_topics():
    scene = FOXGLOVE['configById']['3D!map']
    displays = {d['Topic']['Value'] for d in RVIZ['Displays'] if 'Topic' in d}
    assert scene['topics'].keys() == displays
    goals = {scene['publish'][key].lstrip('/') for key in ('poseTopic', 'poseEstimateTopic')}
    assert goals <= SUBSCRIBED.keys()
    for key, panel in FOXGLOVE['configById'].items():
        if key.startswith('RawMessages'):
            assert panel['topicPath'].lstrip('/') in PUBLISHED
