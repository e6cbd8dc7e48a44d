"""Saved sessions: grid and topological map with all that their builders know, so that work goes on where it was."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.adapters.files import written_aside
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.topology.update import TopologyBuilder, TopologyConfig

_FORMAT = 'thinmap_format'
_GRID, _TOPOLOGY = 'grid 1', 'topology 1'


def write_grid(path: Path, grid: OccupancyGrid) -> None:
    """Write a grid with its exact log odds (NumPy archive), whole or not at all."""
    _write(path, _GRID, grid.state())


def read_grid(path: Path, config: OccupancyConfig | None = None) -> OccupancyGrid:
    """Read a grid that `write_grid` wrote. Raises InputError where the file is none, or of another resolution."""
    try:
        return OccupancyGrid.from_state(_read(path, _GRID), config)
    except InputError as error:
        raise InputError(f'{path}: {error}') from error


def write_topology(path: Path, builder: TopologyBuilder) -> None:
    """Write the global map with its ids and what the builder remembers (NumPy archive), whole or not at all."""
    _write(path, _TOPOLOGY, builder.state())


def read_topology(path: Path, config: TopologyConfig | None = None) -> TopologyBuilder:
    """Read a builder that `write_topology` wrote. Raises InputError where the file is none, or does not fit."""
    try:
        return TopologyBuilder.from_state(_read(path, _TOPOLOGY), config)
    except InputError as error:
        raise InputError(f'{path}: {error}') from error


def _write(path: Path, what: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    named: dict[str, Any] = {_FORMAT: np.array(what), **arrays}
    with written_aside(path) as aside, aside.open('wb') as stream:
        np.savez_compressed(stream, **named)


def _read(path: Path, what: str) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
    except OSError as error:
        raise InputError(error.strerror or str(error)) from error
    except Exception as error:  # zlib and NumPy's readers raise whatever a broken file makes them stumble over
        raise InputError(f'{" ".join(str(error).split())}: expected a saved {what.split()[0]}') from error
    found = arrays.pop(_FORMAT, None)
    if found is None or str(found) != what:
        raise InputError(f'holds {found}: expected a saved {what.split()[0]} ({what})')
    return arrays
