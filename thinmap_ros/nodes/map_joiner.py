"""One map of the maps of several robots, whose places relative to each other are recognized."""

import time

from thinmap_msgs.srv import JoinMaps, SeparateMaps
from thinmap_ros import kernels
from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.joining.team import WORLD, LinkSearch, MapLink, RobotMap, Team
from thinmap_ros.nodes.parts.joining import (
    JointMap,
    MapJoinerConfig,
    RobotMaps,
    TeamPublishers,
    Turns,
    declare_initial_poses,
    odds_text,
    warn_of_confidence,
)
from thinmap_ros.ros import messages, node_main, parameters
from thinmap_ros.ros.diagnostics import OK
from thinmap_ros.ros.lifecycle_node import POLL_S, Result, ThinmapNode, Worker
from thinmap_ros.ros.services import offer
from thinmap_ros.ros.time_jumps import STEADY

_MERGE = 'merge'
_SEARCH = 'search'
_SHARE = 0.3  # of a core that searches and merging may use


class MapJoinerNode(ThinmapNode):
    """ROBOT/map and ROBOT/topology of all robots in; merged_map, merged_topology, tf_static out.

    ROBOT/keyframes and ROBOT/keyframe_poses in, where they are: with them the joint map bends.
    Also merged_regions and join_status out. Services join_maps, which gives the place of a map in
    another one, and separate_maps, which undoes all joins of a map. Only joined maps are published.
    Places are searched for in a thread, a pair of maps at a time.
    """

    def __init__(self) -> None:
        super().__init__('map_joiner')
        warn_of_confidence(self)
        self._config = parameters.declare_config(self, MapJoinerConfig)
        self._initial = declare_initial_poses(self)
        parameters.reject_unknown(self)
        kernels.map_joiner()
        config = self._config
        self._output = TeamPublishers(self, config.merged_map_topic, config.world_frame)
        self._robots = RobotMaps(self, config, self._on_map, self._on_other_map)
        self._worker = Worker(self, _SHARE, self._on_failed)
        self._turns = Turns()
        self.reset_state()
        offer(self.create_active_service, JoinMaps, 'join_maps', self._on_join)
        offer(self.create_active_service, SeparateMaps, 'separate_maps', self._on_separate)
        discovery_s = 1.0 / config.discovery_rate
        self.create_active_timer(discovery_s, self._robots.discover, clock=STEADY)
        self.create_active_timer(POLL_S, self._work, clock=STEADY)
        self.add_activation_callback(self._robots.discover)

    def reset_state(self) -> None:
        """Separate all maps; those of the robots stay."""
        self._team = Team(self._config.join_odds)
        self._joint = JointMap()
        self._worker.drop()
        self._is_merge_due = False
        self._next_merge_s = 0.0  # time of the machine
        self._next_search_s = 0.0
        for name in self._robots.patches:
            self._on_map(name)

    def _on_map(self, name: str) -> None:
        """A robot has another map."""
        is_new = name not in self._team.maps
        self._team.maps[name] = self._robots.map_of(name)
        if is_new and self._config.known_init_poses:
            self._give_initial_pose(name)
        if is_new:
            self._places_changed()
        self._is_merge_due = True

    def _on_other_map(self, name: str) -> None:
        """A robot has begun another map."""
        self.get_logger().warning(f'{name} has begun another map: its place is searched for')
        self._team.begin_again(name)
        self._places_changed()

    def _give_initial_pose(self, name: str) -> None:
        pose = self._initial.get(name)
        if pose is None:
            self.get_logger().warning(
                f'{name}: no {name.rstrip("/")}/map_merge/init_pose_x, _y, _yaw: its place is '
                'searched for'
            )
        else:
            self._report_dropped(self._team.give(WORLD, name, pose))

    def _work(self) -> None:
        """Begin the next job, once the last one is done."""
        if self._worker.is_busy or self._worker.is_resting:
            return
        now_s = time.monotonic()
        ready = [_MERGE] if self._is_merge_due and now_s >= self._next_merge_s else []
        ready += [_SEARCH] if now_s >= self._next_search_s else []
        turn = self._turns.take(ready)
        if turn == _MERGE:
            self._next_merge_s = now_s + 1.0 / self._config.merging_rate
            self._begin_merging()
        elif turn == _SEARCH:
            self._next_search_s = now_s + 1.0 / self._config.estimation_rate
            search = self._team.next_search()
            if search is not None:
                self._worker.begin(lambda: self._searched(search))

    def _on_failed(self, error: Exception) -> None:
        self.get_logger().warning(f'maps are not merged: {error}', throttle_duration_sec=60.0)

    def _searched(self, search: LinkSearch) -> Result:
        """Search, in the thread of the worker."""
        result = search.run()
        return lambda: self._found(search, *result)

    def _found(self, search: LinkSearch, link: MapLink | None, log_odds: float) -> None:
        before = self._team.links.between(search.a, search.b)
        self._report_dropped(self._team.found(search, link, log_odds))
        after = self._team.links.between(search.a, search.b)
        if after is not None and (before is None or not before.matches):
            self.get_logger().info(link_text(after, is_new=True))
        elif after is not None and before is not None and after.contradicts(before):
            self.get_logger().info(link_text(after, is_new=False))
        self._places_changed()

    def _places_changed(self) -> None:
        """Publish where the maps lie, and merge them again."""
        self._publish_places()
        self._is_merge_due = True

    def _publish_places(self) -> None:
        places = self._joint.bend.present_places(self._team.places())
        self._output.publish_places(self._team, places)
        count = len(self._team.maps)
        self.diagnostics.set_state(OK, f'{len(places)} of {count} maps are joined')

    def _begin_merging(self) -> None:
        self._is_merge_due = False
        places = self._team.places()
        if places:
            maps = dict(self._team.maps)
            joint = self._joint
            self._worker.begin(lambda: self._merge(joint, maps, places))

    def _merge(
        self, joint: JointMap, maps: dict[str, RobotMap], places: dict[str, Array]
    ) -> Result:
        """Merge, in the thread of the worker."""
        merge = joint.merge(maps, places)

        def publish() -> None:
            joint.take(merge)
            self._output.publish_map(merge.merged, merge.regions)
            if merge.bend.poses:
                self._publish_places()

        return publish

    def _report_dropped(self, links: list[MapLink]) -> None:
        for link in links:
            self.get_logger().warning(
                f'{link.b} is separated from {link.a} ({odds_text(link.log_odds)}): surer '
                'joins, or the maps as they are now, contradict it'
            )

    def _on_join(self, request: JoinMaps.Request) -> str:
        first = request.first
        second = request.second
        for name in (first, second):
            self._require_map(name, is_world_allowed=name == first)
        if first == second:
            raise InputError(f'second = {quoted(second)}: expected another map than first')
        T = messages.pose_from_msg(request.pose)
        if not se2.is_bounded_pose(T):
            raise InputError(f'pose {T.tolist()}: expected finite numbers')
        self._report_dropped(self._team.give(first, second, T))
        self._places_changed()
        return f'{second} is joined with {first}'

    def _on_separate(self, request: SeparateMaps.Request) -> str:
        self._require_map(request.name)
        self._team.separate(request.name)
        self._joint.begin_ids_again()
        self._places_changed()
        return f'{request.name} is separated until join_maps joins it'

    def _require_map(self, name: str, is_world_allowed: bool = False) -> None:
        """Raise InputError unless there is a map of that name."""
        if name not in self._team.maps and not (is_world_allowed and name == WORLD):
            known = ', '.join(sorted(self._team.maps)) or 'no map yet'
            raise InputError(f'{quoted(name)}: expected one of the maps: {known}')


def link_text(link: MapLink, is_new: bool) -> str:
    """Where a map lies in another, for the log."""
    x, y, yaw = link.T_a_b.tolist()
    what = f'joined with {link.a}' if is_new else f'moved in {link.a}'
    return (
        f'{link.b} is {what}: at x {x:.2f} m, y {y:.2f} m, yaw {yaw:.3f} rad, '
        f'{odds_text(link.log_odds)}, {link.matches} matches'
    )


main = node_main.program(MapJoinerNode)

if __name__ == '__main__':
    main()
