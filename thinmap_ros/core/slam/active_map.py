"""The local map for scan matching, re-rendered from the keyframes after a loop closure."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframe, Keyframes
from thinmap_ros.core.slam.graph.pieces import Pieces
from thinmap_ros.core.slam.matching.local_map import LocalMap, LocalMapConfig


class ActiveMap:
    """The local map of a piece, its loaded cells, and the keyframes that are not yet rendered.

    Loaded cells belong to the published map.
    """

    def __init__(self, config: LocalMapConfig, pieces: Pieces, render_first: int = 20) -> None:
        """render_first: keyframes that are rendered at once after a correction."""
        self._config = config
        self._pieces = pieces
        self._render_first = render_first
        self.map = LocalMap(config)
        self.refused = 0  # scans that lie too far from the others for one map
        self._loaded: Mapping[str, NDArray[Any]] | None = None
        self._loaded_keyframes = 0  # whose scans are in the loaded cells
        self._pending: list[int] = []
        self._revision = 0

    def load(self, given: Mapping[str, NDArray[Any]], keyframes: int) -> None:
        """Set the cells of a `LocalMap.state` with which every re-rendered map starts.

        keyframes: number of the first keyframes that these cells are made of, 0 if they are not
        known. Otherwise a corrected map is rendered from the keyframes alone.
        """
        self._loaded = given
        self._loaded_keyframes = keyframes

    @property
    def is_of_keyframes(self) -> bool:
        """Whether all of the published map can be rendered from keyframes."""
        return self._loaded is None or self._loaded_keyframes > 0

    def add_scan(self, points: Array, T_base_laser: Array, T_map_base: Array) -> bool:
        """Add surface points (N, 5), robot frame, of a scan at a pose (3,).

        Returns False, and counts the scan in `refused`, if the map would become too large.
        """
        return self._add(points, T_base_laser, T_map_base)

    def start_submap(self) -> None:
        """Continue in an empty map."""
        self.map = LocalMap(self._config)
        self._pending = []

    def rerender(self, keyframes: Sequence[Keyframe], T_map_base: Array) -> None:
        """Re-render the map from the keyframes of the piece, those nearest to a pose (3,) first."""
        self.map = self._empty(is_published=not self._pieces.is_apart)
        places = np.array([frame.T_map_base for frame in keyframes]).reshape(-1, 3)[:, :2]
        away = np.hypot(*(places - T_map_base[:2]).T)
        order = np.argsort(-away).tolist()
        first = self._first_rendered
        self._pending = [
            k for k in order if k >= first and self._pieces.is_here(keyframes[k].submap)
        ]
        self._render(keyframes, self._render_first)

    def follow(self, keyframes: Keyframes, T_map_base: Array) -> None:
        """Render the keyframes as they were corrected last, some in each step."""
        if keyframes.revision != self._revision:
            self._revision = keyframes.revision
            self.rerender(keyframes.frames, T_map_base)
        self._render(keyframes.frames)

    def published(self, keyframes: Sequence[Keyframe]) -> LocalMap:
        """The local map of the published piece: rendered again while the robot is in another."""
        if not self._pieces.is_apart:
            return self.map
        rendered = self._empty(is_published=True)
        for frame in keyframes[self._first_rendered :]:
            if self._pieces.is_published(frame.submap):
                with suppress(InputError):  # counted when it was added
                    rendered.add_scan(frame.points, frame.scan.T_base_laser, frame.T_map_base)
        return rendered

    def _render(self, keyframes: Sequence[Keyframe], count: int = 2) -> None:
        """Render up to `count` of the pending keyframes."""
        for _ in range(min(count, len(self._pending))):
            frame = keyframes[self._pending.pop()]
            self._add(frame.points, frame.scan.T_base_laser, frame.T_map_base)

    @property
    def _first_rendered(self) -> int:
        """Number of the first keyframe that is not in the loaded cells."""
        return 0 if self._revision else self._loaded_keyframes

    def _empty(self, is_published: bool) -> LocalMap:
        """An empty map, or the loaded cells, as long as they follow the keyframes."""
        empty = LocalMap(self._config)
        is_corrected = self._loaded_keyframes > 0 and self._revision > 0
        if is_published and self._loaded is not None and not is_corrected:
            empty.restore(self._loaded)
        return empty

    def _add(self, points: Array, T_base_laser: Array, T_map_base: Array) -> bool:
        try:
            self.map.add_scan(points, T_base_laser, T_map_base)
        except InputError:
            self.refused += 1
            return False
        return True
