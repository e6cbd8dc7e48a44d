"""What other robots and map_joiner say to the nodes of one robot, /robot1."""

import numpy as np

from thinmap_msgs.msg import JoinStatus, MapTiles, RobotMap, TeamClaim
from thinmap_ros.core import se2
from thinmap_ros.core.exploration.team import Claim
from thinmap_ros.core.grid.shared import TileSender
from thinmap_ros.core.planning.path_follower import Motion
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.team import RobotClaim, RobotState, claim_msg, tiles_msg

ME = '/robot1'
OTHER = '/robot2'
# Of the maps of both in the world.
PLACES = {ME: se2.pose(5.0, -3.0, 0.4), OTHER: se2.pose(-1.0, 2.0, -1.1)}
T_ME_OTHER = se2.between(PLACES[ME], PLACES[OTHER])


class TeamTalk:
    """Publishes the claims and tiles of /robot2, and where both maps lie."""

    def __init__(self, graph):
        node = graph.node
        self._claims = node.create_publisher(TeamClaim, '/team/claims', qos.SENSOR)
        self._tiles = node.create_publisher(MapTiles, '/team/tiles', qos.LATCHED)
        self._join = node.create_publisher(JoinStatus, '/join_status', qos.LATCHED)
        self._stamp_ns = 0

    def join(self, is_joined=True):
        maps = [
            RobotMap(name=name, is_joined=is_joined, pose=messages.pose_msg(T))
            for name, T in PLACES.items()
        ]
        self._join.publish(JoinStatus(header=messages.header('world', 0), maps=maps))

    def stands_at(self, x, y):
        """/robot2 stands at a place in the map of /robot1."""
        self.drives_at(x, y, 0.0, 0.0)

    def drives_at(self, x, y, theta, v):
        """/robot2 drives at a pose in the map of /robot1, m/s."""
        self._stamp_ns += 1
        pose = se2.between(T_ME_OTHER, se2.pose(x, y, theta))
        claim = Claim(OTHER, self._stamp_ns, pose)
        sent = RobotClaim(claim, Motion(OTHER, pose, v, 0.0), RobotState.WAITING, 1)
        self._claims.publish(claim_msg(sent, 'map'))

    def knows(self, patch):
        """/robot2 sends all of its map."""
        sender = TileSender(patch.frame)
        sender.update(patch)
        header = messages.header('map', 1)
        self._tiles.publish(tiles_msg(header, OTHER, 1, sender.changes_after(0)))


def in_map_of_other(points):
    """Points (N, 2) of the map of /robot1 in that of /robot2."""
    return se2.transform_points(se2.invert(T_ME_OTHER), np.asarray(points))
