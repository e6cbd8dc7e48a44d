"""From the map to its graph."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np

from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.correction import CorrectedPoses
from thinmap_ros.core.grid.mapper import MapUpdate, WholeMap
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.stage import Stage
from thinmap_ros.core.topology.builder import TopologyBuilder
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig

# Before every correction: the graph is rebuilt from the next whole map.
_STALE_NS = -1


class Job(Protocol):
    """A graph that is being rebuilt."""

    def done(self) -> bool:
        """Whether it is complete."""

    def result(self) -> TopologyBuilder:
        """The graph; waits for it."""


class Finished:
    """A job that was done at once."""

    def __init__(self, work: Callable[[], TopologyBuilder]) -> None:
        self._result = work()

    def done(self) -> bool:
        """Whether it is complete."""
        return True

    def result(self) -> TopologyBuilder:
        """The graph."""
        return self._result


class Topology(Stage[MapUpdate, TopologicalMap]):
    """The stage of the graph, which follows the map and its corrections.

    While the map is rendered again the graph takes no cells, nor later those of a map that follows
    another correction than the graph. It is rebuilt when the whole map of a newer one comes;
    changes that come meanwhile are added to the new graph. Nodes keep their ids. A graph that an
    error has left half changed is rebuilt from the next whole map.
    """

    def __init__(
        self, config: TopologyConfig | None = None, begin: Callable[..., Job] = Finished
    ) -> None:
        """begin: calls a function, at once or in a thread."""
        self._config = config
        self._begin = begin
        self.reset()

    @property
    def map(self) -> TopologicalMap:
        """The graph."""
        return self.builder.map

    def reset(self) -> None:
        """Begin again with an empty graph."""
        self.replace(TopologyBuilder(self._config))

    def replace(self, builder: TopologyBuilder) -> None:
        """Continue with another graph, which has followed the corrections of its map."""
        self.builder = builder
        # Of the correction that changes must have undergone: None until there are some.
        self._corrected_ns: int | None = None
        self._newest: MapUpdate | None = None
        self._whole: WholeMap | None = None  # the newest one, until the graph has it
        self._job: Job | None = None
        self._pending: list[MapUpdate] = []

    def state(self) -> State:
        """The graph, and the correction that it follows."""
        # A graph that is being rebuilt does not follow the correction yet.
        corrected_ns = 0 if self._job is not None else max(self._corrected_ns or 0, 0)
        return {**self.builder.state(), 'corrected_ns': np.array(corrected_ns)}

    def restore(self, state: State) -> None:
        """Continue from a state. Raises InputError if it is invalid."""
        corrected_ns, graph = snapshot.split_number(state, 'corrected_ns')
        self.replace(TopologyBuilder.from_state(graph, self._config))
        self._corrected_ns = corrected_ns

    def step(self, update: MapUpdate) -> TopologicalMap | None:
        """Add what has changed in the map; returns the graph if it is another one.

        Raises InputError where the changes do not fit the map.
        """
        self._newest = update
        self._adopt(update)
        if update.whole is not None:
            self._whole = update.whole
        self._paste_changes()
        self._begin_to_rebuild()
        is_changed = self._add_changes(update)
        return self.map if self._add_whole_map() or is_changed else None

    def add_map(self, whole: WholeMap) -> TopologicalMap | None:
        """Add all of the map, once it can be used; returns the graph if it is another one.

        Raises InputError where the newest changes do not fit it.
        """
        self._whole = whole
        self._paste_changes()
        self._begin_to_rebuild()
        is_rebuilt = self._take_rebuilt()
        return self.map if self._add_whole_map() or is_rebuilt else None

    def finish(self) -> None:
        """Wait for the graph that is being rebuilt."""
        if self._job is None:
            return
        job = self._job
        pending = self._pending
        self._job = None
        self._pending = []
        with self._rebuilt_after_errors():
            self.builder = job.result()
        for update in pending:
            self._add(update.changes, update)

    def _adopt(self, update: MapUpdate) -> None:
        """Learn which correction the graph follows, from changes of its map."""
        if self._corrected_ns is None:
            self._corrected_ns = update.corrected_ns
        elif update.corrected_ns < self._corrected_ns <= update.localized.scan.stamp_ns:
            # The mapper was restarted: its map knows of no correction.
            self._corrected_ns = update.corrected_ns

    def _paste_changes(self) -> None:
        """Paste the newest changes into the whole map: they are newer."""
        whole = self._whole
        newest = self._newest
        if whole is None or newest is None or newest.changes is None:
            return
        if newest.corrected_ns == whole.corrected_ns:
            self._whole = None  # unless they fit
            received = MapReceiver()
            received.replace(whole.patch)
            self._whole = replace(whole, patch=received.paste(newest.changes))

    def _accepts_changes(self) -> bool:
        newest = self._newest
        if newest is None or newest.is_rerendering:
            return False
        return newest.corrected_ns == self._corrected_ns

    def _add_changes(self, update: MapUpdate) -> bool:
        """Add changes, now or once the graph is rebuilt; returns whether the graph is another."""
        if self._accepts_changes():
            if self._job is None:
                return self._add(update.changes, update)
            self._pending.append(update)
        return self._take_rebuilt()

    def _add(self, cells: GridPatch | None, update: MapUpdate) -> bool:
        with self._rebuilt_after_errors():
            return cells is not None and self.builder.update(cells, update.localized.T_map_base)

    @contextmanager
    def _rebuilt_after_errors(self) -> Iterator[None]:
        """Rebuild the graph from the next whole map if a change of it ends half done."""
        try:
            yield
        except InputError:
            raise  # changes that do not fit are refused before anything is done
        except Exception:
            self._corrected_ns = _STALE_NS
            raise

    def _take_rebuilt(self) -> bool:
        if self._job is None or not self._job.done():
            return False
        self.finish()
        return True

    def _add_whole_map(self) -> bool:
        """Update the graph by the newest whole map: beams may end outside of the windows."""
        whole = self._whole
        if whole is None or self._newest is None or self._job is not None:
            return False
        if whole.corrected_ns != self._corrected_ns or not self._accepts_changes():
            return False
        self._whole = None
        return self._add(whole.patch, self._newest)

    def _begin_to_rebuild(self) -> None:
        whole = self._whole
        corrected_ns = self._corrected_ns
        if whole is None or corrected_ns is None or corrected_ns >= whole.corrected_ns:
            return
        self.finish()
        # Where another correction is missing, nodes are searched for where they were.
        is_next = whole.previous_ns == corrected_ns
        moved = whole.moved if is_next else CorrectedPoses(whole.moved.after, whole.moved.after)
        self._corrected_ns = whole.corrected_ns
        self._whole = None
        with self._rebuilt_after_errors():
            self._job = self._begin(partial(self.builder.rebuilt, whole.patch, *moved))
