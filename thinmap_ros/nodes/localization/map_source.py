"""The map that a localizer localizes in: of a file, a session, or a topic."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from thinmap_ros.core.errors import ConfigError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.slam.localizer import AnyLocalizer, Localizer, localizer_class
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.stage import StartConfig
from thinmap_ros.files import sessions
from thinmap_ros.files.occupancy_maps import Report, read_map
from thinmap_ros.nodes.localization.config import LocalizationConfig
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.maps import subscribe_to_map


class MapSource:
    """Creates localizers in the given map.

    patch: None until topic map is received, where no other map is given. name: of the map, to which
    a saved pose belongs.
    """

    def __init__(
        self,
        config: StartConfig,
        localization: LocalizationConfig,
        session: str,
        report: Report,
    ) -> None:
        """report: receives lines on the map that is read.

        Raises ConfigError where the parameters contradict each other, InputError for a file.
        """
        self._report = report
        self._session = session
        self._is_mapping = config.is_mapping
        self._first_map_only = localization.first_map_only
        self.patch: GridPatch | None = None
        self._has_loaded = False
        file = localization.map_file_name
        self.name = file or session or 'topic map'
        if self._is_mapping:
            if file:
                raise ConfigError('map_file_name is given: expected mode = localization')
            return
        if not session and not isinstance(config, LocalizerConfig):
            raise ConfigError(
                f'mode = localization with slam = {config.slam}: expected a session_path with its '
                'line features'
            )
        if file:
            self.patch = read_map(Path(file), report=report)

    @property
    def has_map(self) -> bool:
        """Whether there is a map, or none is needed."""
        return self._is_mapping or bool(self._session or self._has_loaded) or self.patch is not None

    @property
    def _is_topic(self) -> bool:
        return not self._is_mapping and self.name == 'topic map'

    def create_localizer(self, config: StartConfig) -> AnyLocalizer:
        """A localizer at the configured pose, delocalized if in a given map."""
        if self.patch is not None and isinstance(config, LocalizerConfig):
            return Localizer.in_occupancy_map(self.patch, config)
        if self._session:
            loaded = load_localizer(self._session, config, report=self._report)
            if loaded is not None:
                return loaded
        return localizer_class(config)(config)

    def replace(self, patch: GridPatch) -> bool:
        """Take another map; returns whether it is different."""
        if self.patch is not None and (
            self.patch.frame == patch.frame and np.array_equal(self.patch.cells, patch.cells)
        ):
            return False
        self.patch = patch
        return True

    def replaced(self) -> None:
        """A service has loaded another map: there is one."""
        self._has_loaded = True

    def subscribe(self, node: ThinmapNode, changed: Callable[[], None]) -> None:
        """Subscribe to topic map if the map is to come from there; changed: there is a new one."""
        if not self._is_topic:
            return

        def on_map(patch: GridPatch) -> None:
            if self.patch is not None and self._first_map_only:
                return
            if self.replace(patch):
                changed()

        subscribe_to_map(node, 'map', on_map)


def load_localizer(
    path: str, config: StartConfig, folder: Path | None = None, *, report: Report
) -> AnyLocalizer | None:
    """Localizer in the map of a session, or in its grid: any map_server map.

    folder, report: as in `read_map`. None: no map that this localizer can use.
    Raises InputError where a file is broken, or the path names no map.
    """
    loaded = sessions.load_localizer(path, config)
    if loaded is not None or not isinstance(config, LocalizerConfig):
        return loaded
    grid = sessions.load_grid(path, None, folder, report)
    return Localizer.in_occupancy_map(grid.known_area(), config)
