"""Saves what a node has made when it ends, and now and then before."""

from collections.abc import Callable
from typing import Any

from thinmap_ros.core.errors import ThinmapError
from thinmap_ros.files.sessions import SessionPart, require_own_files
from thinmap_ros.ros import parameters
from thinmap_ros.ros.clocks.time_jumps import STEADY
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.save_directory import SaveDirectory


class ExitSave:
    """A node's part of the session of `save_on_exit`; one without a map saves none."""

    def __init__(
        self,
        node: ThinmapNode,
        directory: SaveDirectory,
        part: SessionPart[Any, Any],
        save: Callable[[str], str],
    ) -> None:
        """save: saves to a path, and returns what was saved; '' for nothing.

        Raises InputError where the parameter names no path below the directory, or a file that is
        not of thinmap.
        """
        given = str(
            parameters.declare_parameter(
                node,
                'save_on_exit',
                '',
                'Path stem of the session that is saved when the node ends, below save_directory. '
                'Empty: none. Give it to localizer, grid_mapper and topology_builder.',
            )
        )
        period_s = float(
            parameters.declare_parameter(
                node,
                'autosave_period_s',
                0.0,
                'Time after which the session of save_on_exit is saved again (s). 0: only at the '
                'end. Set it where the power may fail.',
                low=0.0,
            )
        )
        self._node = node
        self._save = save
        if not given:
            return
        self._path = directory.resolve(given)
        require_own_files(self._path, part)
        node.add_end_callback(self._save_now)
        if period_s > 0.0:
            node.create_timer(period_s, self._save_now, clock=STEADY)

    def _save_now(self) -> None:
        try:
            if saved := self._save(self._path):
                self._node.get_logger().info(saved)
        except (ThinmapError, OSError) as error:
            self._node.get_logger().error(f'save_on_exit: {error}')
