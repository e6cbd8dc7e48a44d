"""Saved sessions, to go on from: grid and topological map with all that their builders know.

A session has a path STEM: STEM.grid.npz holds the grid, STEM.pgm and STEM.yaml the same as a
map_server map, STEM.topology.npz the graph with its ids, STEM.features.npz the localizer's features
and local map, and STEM.exploration.npz what an exploration of it has learned.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError, one_line_reason, quoted
from thinmap_ros.core.exploration.explorer import Explorer, ExplorerConfig
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.slam.localizer import ScanLocalizerConfig
from thinmap_ros.core.slam.localizers import AnyLocalizer, localizer_class
from thinmap_ros.core.topology.builder import TopologyBuilder, TopologyConfig
from thinmap_ros.files.atomic import atomic_write
from thinmap_ros.files.npz import open_regular_file, read_arrays
from thinmap_ros.files.occupancy_maps import read_map, write_map

_FORMAT = 'thinmap_format'
_GRID = 'grid 1'
_TOPOLOGY = 'topology 1'
_EXPLORATION = 'exploration 1'
_FEATURES = 'features 2'
_GRID_END = '.grid.npz'
_TOPOLOGY_END = '.topology.npz'
_MAP_END = '.yaml'
_EXPLORATION_END = '.exploration.npz'
_FEATURES_END = '.features.npz'
# Of all files that a session may consist of, or that are set aside with a new one.
_OLD = '.old'
_KEPT = (_TOPOLOGY_END, _EXPLORATION_END, _FEATURES_END)
ENDINGS = (_GRID_END, _MAP_END, '.pgm', *_KEPT, *(end + _OLD for end in _KEPT))


def stem_of(path: str) -> Path:
    """STEM of a session, given as such or as one of its files.

    It is absolute, as nodes may have been started elsewhere.
    Raises InputError where it names nothing.
    """
    for end in (_GRID_END, _TOPOLOGY_END, _EXPLORATION_END, _FEATURES_END, _MAP_END, '.pgm'):
        path = path.removesuffix(end)
    if not Path(path).name or '\0' in path:
        expected = 'expected the path of a session, without the endings of its files'
        raise InputError(f'{quoted(path)}: {expected}')
    return Path(path).absolute()


def save_grid(path: str, grid: OccupancyGrid) -> str:
    """Write STEM.pgm, STEM.yaml and STEM.grid.npz; returns what was written.

    Raises OSError where that fails.
    """
    stem = stem_of(path)
    # All files are written before any takes its name: a full disk leaves the old session as it was.
    with atomic_write(_named(stem, _GRID_END)) as aside:
        _write_to(aside, _GRID, grid.state())
        write_map(stem, grid.known_area())
    return f'{stem}.pgm, {_MAP_END} and {_GRID_END}'


def load_grid(
    path: str, config: OccupancyConfig | None = None, folder: Path | None = None
) -> OccupancyGrid:
    """Read STEM.grid.npz or, where that is not there, STEM.yaml and its image: any map_server map.

    folder: where given, the image has to lie below it. Raises InputError where there is neither, or
    one is broken or of another resolution.
    """
    stem = stem_of(path)
    exact = _named(stem, _GRID_END)
    description = _named(stem, _MAP_END)
    if _is_there(exact) or path.endswith(_GRID_END):
        return read_grid(exact, config)
    if not _is_there(description):
        raise InputError(f'{stem}: neither {exact.name} nor {description.name} is there')
    patch = read_map(description, folder)
    try:
        return OccupancyGrid.from_patch(patch, config)
    except InputError as error:
        raise InputError(f'{description}: {error}') from error


def save_topology(path: str, builder: TopologyBuilder) -> str:
    """Write STEM.topology.npz; returns its name. Raises OSError where that fails."""
    file = _named(stem_of(path), _TOPOLOGY_END)
    write_topology(file, builder)
    return str(file)


def load_topology(
    path: str, config: TopologyConfig | None = None, resolution_m: float | None = None
) -> TopologyBuilder:
    """Read STEM.topology.npz.

    Raises InputError as `read_topology`, and where its cells are not of the resolution.
    """
    file = _named(stem_of(path), _TOPOLOGY_END)
    builder = read_topology(file, config)
    if None not in (resolution_m, builder.resolution_m) and builder.resolution_m != resolution_m:
        raise InputError(
            f'{file}: made from {builder.resolution_m} m a cell: expected {resolution_m} m'
        )
    return builder


def save_exploration(path: str, explorer: Explorer) -> str:
    """Write STEM.exploration.npz; returns its name. Raises OSError where that fails."""
    file = _named(stem_of(path), _EXPLORATION_END)
    _write(file, _EXPLORATION, explorer.state())
    return str(file)


def load_exploration(path: str, config: ExplorerConfig | None = None) -> Explorer | None:
    """Read STEM.exploration.npz; None where the session has none.

    Raises InputError where it is broken.
    """
    file = _named(stem_of(path), _EXPLORATION_END)
    if not _is_there(file):
        return None
    try:
        return Explorer.from_state(_read(file, _EXPLORATION), config)
    except InputError as error:
        raise InputError(f'{file}: {error}') from error


def save_features(path: str, localizer: AnyLocalizer) -> str:
    """Write STEM.features.npz; returns its name. Raises OSError where that fails."""
    file = _named(stem_of(path), _FEATURES_END)
    _write(file, _FEATURES, localizer.state())
    return str(file)


def load_features(path: str, config: ScanLocalizerConfig | None = None) -> AnyLocalizer | None:
    """Read STEM.features.npz; None where the session has none.

    Raises InputError where it is broken.
    """
    file = _named(stem_of(path), _FEATURES_END)
    if not _is_there(file):
        return None
    try:
        kind = localizer_class(config or ScanLocalizerConfig())
        return kind.from_state(_read(file, _FEATURES), config)
    except InputError as error:
        raise InputError(f'{file}: {error}') from error


def has_topology(path: str) -> bool:
    """Whether a session has a graph."""
    return _is_there(_named(stem_of(path), _TOPOLOGY_END))


def set_topology_aside(path: str) -> str:
    """Keep a graph that was saved with an earlier grid as STEM.topology.npz.old.

    Returns what was done, or ''.
    """
    aside = _set_aside(path, _TOPOLOGY_END)
    return f'; the graph of an earlier grid is now {aside}' if aside else ''


def set_exploration_aside(path: str) -> str:
    """Keep what an exploration of an earlier grid has learned as STEM.exploration.npz.old.

    Returns as above.
    """
    aside = _set_aside(path, _EXPLORATION_END)
    return f'; what was learned of an earlier grid is now {aside}' if aside else ''


def set_features_aside(path: str) -> str:
    """Keep features that were saved with an earlier grid as STEM.features.npz.old.

    Returns as above.
    """
    aside = _set_aside(path, _FEATURES_END)
    return f'; the features of an earlier grid are now {aside}' if aside else ''


def _set_aside(path: str, end: str) -> Path | None:
    file = _named(stem_of(path), end)
    return file.replace(file.with_name(f'{file.name}{_OLD}')) if _is_there(file) else None


def write_grid(path: Path, grid: OccupancyGrid) -> None:
    """Write a grid with its exact log odds (NumPy archive), whole or not at all."""
    _write(path, _GRID, grid.state())


def read_grid(path: Path, config: OccupancyConfig | None = None) -> OccupancyGrid:
    """Read a grid that `write_grid` wrote.

    Raises InputError where the file is none, or of another resolution.
    """
    try:
        return OccupancyGrid.from_state(_read(path, _GRID), config)
    except InputError as error:
        raise InputError(f'{path}: {error}') from error


def write_topology(path: Path, builder: TopologyBuilder) -> None:
    """Write the global map, its ids and the builder's memory (NumPy archive), all or nothing."""
    _write(path, _TOPOLOGY, builder.state())


def read_topology(path: Path, config: TopologyConfig | None = None) -> TopologyBuilder:
    """Read a builder that `write_topology` wrote.

    Raises InputError where the file is none, or does not fit.
    """
    try:
        return TopologyBuilder.from_state(_read(path, _TOPOLOGY), config)
    except InputError as error:
        raise InputError(f'{path}: {error}') from error


def _named(stem: Path, end: str) -> Path:
    return stem.with_name(stem.name + end)


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except OSError as error:
        raise InputError(f'{path}: {error.strerror or error}') from error


def _write(path: Path, what: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    with atomic_write(path) as aside:
        _write_to(aside, what, arrays)


def _write_to(path: Path, what: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    named: dict[str, Any] = {_FORMAT: np.array(what), **arrays}
    with path.open('wb') as stream:
        np.savez_compressed(stream, **named)


def _read(path: Path, what: str) -> dict[str, NDArray[Any]]:
    expected = f'expected a saved {what.split()[0]}'
    try:
        with open_regular_file(path) as stream:
            arrays = read_arrays(stream)
    except OSError as error:
        raise InputError(error.strerror or one_line_reason(error)) from error
    except InputError as error:
        raise InputError(f'{error}: {expected}') from error
    found = arrays.pop(_FORMAT, np.empty(0))
    if found.shape or found.dtype.kind != 'U' or str(found) != what:
        raise InputError(f'holds {quoted(str(found))}: {expected} ({what})')
    return arrays
