"""Regions of a growing map with ids that stay."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.regions import names as region_names
from thinmap_ros.core.regions.config import RegionConfig
from thinmap_ros.core.regions.names import RegionNames
from thinmap_ros.core.regions.region_map import RegionMap
from thinmap_ros.core.regions.segmentation import describe, segment
from thinmap_ros.core.snapshot import MAX_COUNT, MAX_ID, Field

Labels = NDArray[np.int32]
_UPDATES = 5  # after which a cell forgets its earlier id
_STRIDE_M = 0.4  # between the cells that a state keeps
_OWN_FIELDS = {
    'region_frame': Field(np.float64, (3,), -snapshot.MAX_COORDINATE_M, snapshot.MAX_COORDINATE_M),
    'region_labels': Field(np.int32, ('r', 'c'), 0, MAX_ID),
    'next_region_id': Field(np.int64, (), 1, MAX_COUNT),
}
FIELDS = {**_OWN_FIELDS, **region_names.FIELDS}


class _Memory:
    """Ids of the cells (H, W) of a grid: remembered, and at the last update.

    changed: since how many updates they differ.
    """

    def __init__(
        self,
        frame: GridFrame,
        labels: Labels,
        last: Labels | None = None,
        changed: NDArray[np.int16] | None = None,
    ) -> None:
        self.frame = frame
        self.labels = labels
        self.last = labels if last is None else last
        self._changed = np.zeros(labels.shape, dtype=np.int16) if changed is None else changed

    def resampled(self, patch: GridPatch) -> '_Memory':
        """The same memory on the cells of a patch."""
        frame = patch.frame
        ratio = frame.resolution / self.frame.resolution
        low_row = (frame.origin_y - self.frame.origin_y) / self.frame.resolution
        low_col = (frame.origin_x - self.frame.origin_x) / self.frame.resolution
        rows = np.floor(low_row + (np.arange(patch.shape[0]) + 0.5) * ratio).astype(np.int64)
        cols = np.floor(low_col + (np.arange(patch.shape[1]) + 0.5) * ratio).astype(np.int64)
        # A row and a column of zeros stand for all that is outside.
        here = np.ix_(
            np.where((rows >= 0) & (rows < self.labels.shape[0]), rows, -1),
            np.where((cols >= 0) & (cols < self.labels.shape[1]), cols, -1),
        )
        arrays = (self.labels, self.last, self._changed)
        return _Memory(frame, *(np.pad(array, ((0, 1), (0, 1)))[here] for array in arrays))

    def updated(self, labels: Labels) -> '_Memory':
        """The memory after an update with the ids (H, W); cells in no region keep theirs."""
        changed = np.where((labels == self.labels) | (labels == 0), 0, self._changed + 1)
        is_new = (labels > 0) & ((self.labels == 0) | (changed >= _UPDATES))
        kept = np.where(is_new, labels, self.labels)
        return _Memory(self.frame, kept, labels, np.where(is_new, 0, changed).astype(np.int16))


class RegionTracker:
    """Finds the regions of the present grid; a region keeps the id of the one that it continues.

    An earlier region is continued by the one that overlaps it most; of several that claim the same
    region, the one with the largest overlap. So the larger part keeps the id at a split, and the
    larger region at a merge. No other region ever gets the id.
    Each cell remembers its id until it has had another one for some updates. So a region that is
    merged with another one for a moment, as a door closes, has its id again afterwards.

    names: that people have given, which the regions here do not have yet.
    """

    def __init__(self, config: RegionConfig | None = None) -> None:
        self.config = config or RegionConfig()
        self.regions: RegionMap | None = None
        self.names = RegionNames()
        self._memory: _Memory | None = None
        self._next_id = 1

    def update(self, patch: GridPatch) -> RegionMap:
        """Regions of a grid, which need not have the frame or size of the last one."""
        found = segment(patch, self.config)
        before = self._memory or _Memory(patch.frame, np.zeros(patch.shape, dtype=np.int32))
        memory = before.resampled(patch)
        self.regions = describe(found, self._ids(found.labels, memory), self.config)
        self._memory = memory.updated(self.regions.labels)
        return self.regions

    def skip_ids(self, count: int) -> None:
        """Never assign the next so many ids: they may be in use elsewhere."""
        self._next_id += count

    def state(self) -> dict[str, NDArray[Any]]:
        """Arrays by name, empty before the first update; `from_state` continues from them."""
        memory = self._memory  # another thread may replace it by one of other cells
        if memory is None:
            return {}
        frame = memory.frame
        labels = np.where(memory.last > 0, memory.last, memory.labels)
        stride = max(1, round(_STRIDE_M / frame.resolution))
        coarse = GridFrame(frame.origin_x, frame.origin_y, stride * frame.resolution)
        return {
            'region_frame': coarse.as_array(),
            'region_labels': labels[stride // 2 :: stride, stride // 2 :: stride],
            'next_region_id': np.array(self._next_id),
            **self.names.state(),
        }

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: RegionConfig | None = None
    ) -> 'RegionTracker':
        """Tracker that continues from the `state` of another one.

        Its regions are known with the next grid. Raises InputError where it is no such state.
        """
        tracker = RegionTracker(config)
        if not state:
            return tracker
        own = {name: array for name, array in state.items() if name not in region_names.FIELDS}
        checked = snapshot.validate(own, _OWN_FIELDS, 'regions')
        if len(own) < len(state):  # none where they were saved by an earlier version
            named = {name: state[name] for name in state.keys() - own.keys()}
            tracker.names = RegionNames.from_state(named)
        labels = checked['region_labels']
        tracker._next_id = int(checked['next_region_id'])
        if labels.max(initial=0) >= tracker._next_id:
            raise InputError(
                f'saved regions: id {labels.max()}: expected ids below {tracker._next_id}'
            )
        tracker._memory = _Memory(GridFrame(*checked['region_frame'].tolist()), labels)
        return tracker

    def _ids(self, labels: Labels, memory: _Memory) -> NDArray[np.int64]:
        """Ids (R + 1,) of the regions (H, W) of a grid, by number."""
        ids = np.zeros(1 + int(labels.max(initial=0)), dtype=np.int64)
        used = {0}
        # What has been new since the last few updates is not remembered yet.
        for number, earlier in [*_claims(labels, memory.labels), *_claims(labels, memory.last)]:
            if ids[number] == 0 and earlier not in used:
                ids[number] = earlier
                used.add(earlier)
        for number in np.flatnonzero(ids == 0)[1:].tolist():
            ids[number] = self._next_id
            self._next_id += 1
        return ids


def _claims(labels: Labels, before: Labels) -> Iterator[tuple[int, int]]:
    """The region (H, W) that overlaps each earlier one (H, W) most, largest overlap first."""
    both = (labels > 0) & (before > 0)
    # A number of 64 bits for each pair: sorted in a tenth of the time.
    pairs = (labels[both].astype(np.int64) << 32) + before[both]
    values, cells = np.unique(pairs, return_counts=True)
    claimed: set[int] = set()
    for pair in values[np.argsort(-cells, kind='stable')].tolist():
        number = pair >> 32
        earlier = pair - (number << 32)
        if earlier not in claimed:
            claimed.add(earlier)
            yield number, earlier
