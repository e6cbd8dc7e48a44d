"""Saved sessions: the state of grid mapper, topology builder, localizer and explorer.

A session has a path STEM. `PARTS` lists its files, one for each node. Beside STEM.grid.npz lies the
same grid as a map_server map, STEM.pgm and STEM.yaml, and STEM.edits.npz of a map that was edited.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import copyfile
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import InputError, one_line_reason, quoted
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.core.grid.correction import CorrectableGrid
from thinmap_ros.core.grid.edits import KeepOut, MapEdits
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import SavedKeyframes
from thinmap_ros.core.slam.graph.reduction import reduced
from thinmap_ros.core.slam.localizer import AnyLocalizer, Localizer, localizer_class, tag_of
from thinmap_ros.core.slam.matching import local_map
from thinmap_ros.core.slam.matching.local_map import LocalMapConfig
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.stage import StartConfig
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.segmentation import RegionTracker
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.files.occupancy_maps import (
    Report,
    is_own_map,
    read_map,
    read_resolution,
    read_tag,
    warn,
    write_map,
)
from thinmap_ros.files.safe import (
    atomic_write,
    is_snapshot,
    open_regular_file,
    read_snapshot,
    uninterrupted,
    write_snapshot,
)

_MAP_ENDING = '.yaml'
_IMAGE_ENDING = '.pgm'
_ARCHIVED = '.old'


class _HasState(Protocol):
    def state(self) -> State: ...


Value = TypeVar('Value', bound=_HasState)
PartConfig = TypeVar('PartConfig')
Read = TypeVar('Read')


@dataclass(frozen=True)
class SessionPart(Generic[Value, PartConfig]):
    """A file of a session: the state of one node (NumPy archive).

    node: its services save_NAME and load_NAME write and read the file. ending: of the file, after
    STEM. restore: makes the value from its arrays and a
    configuration; raises InputError where they do not fit. content: names of the arrays that are
    zero or empty where there is nothing in the file.
    """

    name: str
    node: str
    ending: str
    restore: Callable[[State, PartConfig | None], Value]
    content: tuple[str, ...] = ()

    def file(self, path: str) -> Path:
        """Path of the file. Raises InputError as `stem_of`."""
        return _with_ending(stem_of(path), self.ending)

    def exists(self, path: str) -> bool:
        """Whether the session has this part."""
        return _exists(self.file(path))

    def save(self, path: str, value: Value, overwrite: bool = False) -> str:
        """Write the file, whole or not at all; returns its path.

        Raises OSError, and InputError as `require_no_loss`.
        """
        file = self.file(path)
        self.require_no_loss(path, value, overwrite)
        with atomic_write(file) as aside:
            self.write(aside, value)
        return str(file)

    def load(self, path: str, config: PartConfig | None = None) -> Value:
        """Read the file.

        Raises InputError where it is missing, broken, of another version or configuration.
        """
        return self.read(self.file(path), config)

    def load_optional(self, path: str, config: PartConfig | None = None) -> Value | None:
        """Read the file; None where the session does not have it. Raises InputError as `load`."""
        return self.load(path, config) if self.exists(path) else None

    def require_no_loss(self, path: str, value: Value, overwrite: bool = False) -> None:
        """Raise InputError where nothing would replace something, unless that is wanted.

        A file that cannot be read, as of another version, holds something.
        """
        if overwrite or not self.content or self.has_content(value.state()):
            return
        file = self.file(path)
        if not _exists(file):
            return
        try:
            with open_regular_file(file) as stream:
                if not self.has_content(read_snapshot(stream, self.name)):
                    return
        except (InputError, OSError):
            pass
        raise InputError(
            f'{file}: exists, and {self.node} has nothing to save yet: expected another name, or '
            'overwrite: true'
        )

    def has_content(self, state: State) -> bool:
        """Whether the state of a node holds something."""
        return any(bool(np.any(state[name])) for name in self.content if name in state)

    def archive(self, path: str) -> str:
        """Rename the file of an earlier session to *.old; returns what was done, '' for nothing.

        Raises OSError.
        """
        file = self.file(path)
        if not _exists(file):
            return ''
        archived = file.replace(file.with_name(f'{file.name}{_ARCHIVED}'))
        return f'{file.name} of an earlier session renamed to {archived}'

    def write(self, file: Path, value: Value) -> None:
        """Write a file of any name. Raises OSError."""
        with file.open('wb') as stream:
            write_snapshot(stream, self.name, value.state())

    def read(self, file: Path, config: PartConfig | None = None) -> Value:
        """Read a file of any name. Raises InputError as `load`."""
        try:
            with open_regular_file(file) as stream:
                state = read_snapshot(stream, self.name)
            return self.restore(state, config)
        except OSError as error:
            raise InputError(f'{file}: {error.strerror or one_line_reason(error)}') from error
        except InputError as error:
            raise InputError(f'{file}: {error}') from error


def _restore_localizer(state: State, config: StartConfig | None) -> AnyLocalizer:
    own = config or LocalizerConfig()
    _require_own_map(state, own)
    return localizer_class(own).from_state(state, own)


def _require_own_map(state: State, config: StartConfig) -> None:
    """Raise InputError where a map is that of another localizer than the configured one."""
    foreign = 'ids' if isinstance(config, LocalizerConfig) else 'hits'
    if foreign in state:
        raise InputError(f'map of another localizer: expected one of slam: {config.slam}')


GRID = SessionPart(
    'grid', 'grid_mapper', '.grid.npz', OccupancyGrid.from_state, content=('log_odds',)
)
# Keep-out areas and erased parts: written and read with the grid.
EDITS = SessionPart('edits', 'grid_mapper', '.edits.npz', MapEdits.from_state)
TOPOLOGY = SessionPart(
    'topology',
    'topology_builder',
    '.topology.npz',
    TopologyBuilder.from_state,
    content=('nodes',),
)
# Ids of the regions: the node of the topology saves and loads them with it.
REGIONS = SessionPart('regions', 'topology_builder', '.regions.npz', RegionTracker.from_state)
# Line features or local map, by the configured localizer.
LOCALIZER = SessionPart(
    'localizer', 'localizer', '.slam.npz', _restore_localizer, content=('ids', 'hits')
)
# Of the local map: `save_localizer` and `load_localizer` write and read both files.
KEYFRAMES = SessionPart('keyframes', 'localizer', '.keyframes.npz', SavedKeyframes.from_state)
EXPLORATION = SessionPart(
    'exploration', 'explorer', '.exploration.npz', Explorer.from_state, content=('ids',)
)
_OF_MAP: tuple[SessionPart[Any, Any], ...] = (GRID, EDITS, TOPOLOGY, REGIONS, LOCALIZER, KEYFRAMES)
PARTS = (*_OF_MAP, EXPLORATION)
# Parts that are saved, and archived, with that of the same node.
_BESIDE: dict[str, SessionPart[Any, Any]] = {TOPOLOGY.name: REGIONS, LOCALIZER.name: KEYFRAMES}
_FILE_ENDINGS = (*(part.ending for part in PARTS), _MAP_ENDING, _IMAGE_ENDING)
# Of all files that a session may consist of, or that are archived when it is saved.
ENDINGS = (*_FILE_ENDINGS, *(part.ending + _ARCHIVED for part in PARTS))


def stem_of(path: str) -> Path:
    """Absolute STEM of a session, given as such or as one of its files.

    Raises InputError where it names nothing.
    """
    for ending in _FILE_ENDINGS:
        path = path.removesuffix(ending)
    if not Path(path).name or '\0' in path:
        expected = 'expected the path of a session, without the endings of its files'
        raise InputError(f'{quoted(path)}: {expected}')
    return Path(path).absolute()


def maps_in(folder: Path) -> list[str]:
    """Sessions (path STEM) and map_server YAML files of a folder, in the order of their names."""
    sessions = {str(path).removesuffix(GRID.ending) for path in folder.glob(f'*{GRID.ending}')}
    maps = [str(path) for path in folder.glob(f'*{_MAP_ENDING}')]
    alone = {path for path in maps if path.removesuffix(_MAP_ENDING) not in sessions}
    return sorted(sessions | alone)


def require_session(path: str) -> None:
    """Raise InputError where a path names no session: none of its files, and no map, exists."""
    stem = stem_of(path)
    endings = [*(part.ending for part in PARTS), _MAP_ENDING]
    if not any(_exists(_with_ending(stem, ending)) for ending in endings):
        raise InputError(f'{stem}: no such session: expected one of {", ".join(endings)}')


def require_own_files(path: str, part: SessionPart[Any, Any]) -> None:
    """Raise InputError where saving a part would replace a file that thinmap has not written.

    With the grid, the files of all parts are checked, and the map beside it.
    """
    stem = stem_of(path)
    for each in PARTS if part is GRID else saved_with(part):
        for ending in (each.ending, each.ending + _ARCHIVED):
            file = _with_ending(stem, ending)
            if _exists(file) and not is_snapshot(file):
                raise _foreign_error(file)
    if part is not GRID or is_snapshot(GRID.file(path)):
        return
    description = _with_ending(stem, _MAP_ENDING)
    for file in (description, _with_ending(stem, _IMAGE_ENDING)):
        if _exists(file) and not is_own_map(description):
            raise _foreign_error(file)


def saved_with(part: SessionPart[Any, Any]) -> tuple[SessionPart[Any, Any], ...]:
    """The part, and the one that its node saves beside it."""
    beside = _BESIDE.get(part.name)
    return (part,) if beside is None else (part, beside)


def _foreign_error(file: Path) -> InputError:
    return InputError(
        f'{file}: exists, and was not written by thinmap: expected another name for the session'
    )


def save_grid(
    path: str,
    grid: OccupancyGrid,
    shown: GridPatch | None = None,
    edits: MapEdits | None = None,
    overwrite: bool = False,
    tag: str = '',
) -> str:
    """Write STEM.pgm, STEM.yaml and STEM.grid.npz; returns what was written.

    Raises as `SessionPart.save`.

    shown: the cells of the image, where they differ from those of the grid. edits: of the map, in
    STEM.edits.npz; where there are none, those of an earlier session are archived. tag: of the
    storey, in STEM.yaml.
    """
    stem = stem_of(path)
    GRID.require_no_loss(path, grid, overwrite)
    # No file takes its name before all are written: a full disk leaves the old session unchanged.
    with atomic_write(GRID.file(path)) as aside:
        GRID.write(aside, grid)
        write_map(stem, grid.known_area() if shown is None else shown, tag)
        if edits:
            EDITS.save(path, edits)
            return f'{stem}.pgm, {_MAP_ENDING}, {EDITS.ending} and {GRID.ending}'
        EDITS.archive(path)
    return f'{stem}.pgm, {_MAP_ENDING} and {GRID.ending}'


def load_grid(
    path: str,
    config: OccupancyConfig | None = None,
    folder: Path | None = None,
    report: Report = warn,
) -> OccupancyGrid:
    """Read STEM.grid.npz or, where it is missing, STEM.yaml and its image: any map_server map.

    The grid has the resolution of the file. folder, report: as in `read_map`.
    Raises InputError where both are missing, or one is broken.
    """
    stem = stem_of(path)
    description = description_of(path)
    if GRID.exists(path) or path.endswith(GRID.ending):
        return GRID.load(path, config)
    if not _exists(description):
        raise InputError(f'{stem}: neither {GRID.file(path).name} nor {description.name} exists')
    return OccupancyGrid.from_patch(read_map(description, folder, report), config)


def description_of(path: str) -> Path:
    """STEM.yaml of a map; where it is missing, a file of another kind, which the reader names."""
    description = _with_ending(stem_of(path), _MAP_ENDING)
    return Path(path) if Path(path).is_file() and not _exists(description) else description


def load_edits(path: str) -> MapEdits:
    """Edits of STEM.grid.npz; none where the session has no such file, or the map is an image.

    Raises InputError as `SessionPart.load`.
    """
    edits = EDITS.load_optional(path) if GRID.exists(path) else None
    return edits or MapEdits()


def load_map(
    path: str,
    config: OccupancyConfig | None = None,
    is_mapping: bool = True,
    folder: Path | None = None,
    report: Report = warn,
) -> tuple[CorrectableGrid, KeepOut]:
    """The map of a session, or any map_server map, and its keep-out areas.

    It is corrected if the session has keyframes, and is_mapping. folder, report: as in `read_map`.
    Raises InputError as `load_grid`.
    """
    grid = load_grid(path, config, folder, report)
    scans = load_scans(path) if is_mapping else []
    edits = load_edits(path)
    return CorrectableGrid(grid, bool(scans), scans=scans, erasures=edits.erasures), edits.keep_out


def load_scans(path: str) -> list[tuple[Scan, Array]]:
    """Scans of the keyframes, with their poses (3,), that STEM.grid.npz can be rendered from.

    None where the session has no keyframes, or the map is that of an image. Raises InputError as
    `SessionPart.load`.
    """
    keyframes = KEYFRAMES.load_optional(path) if GRID.exists(path) else None
    return [] if keyframes is None else keyframes.scans


def save_localizer(path: str, localizer: AnyLocalizer, overwrite: bool = False) -> str:
    """Write STEM.slam.npz, and STEM.keyframes.npz of a map that is made of keyframes.

    The keyframes of an earlier session are archived otherwise. Returns what was written. Raises as
    `SessionPart.save`.
    """
    LOCALIZER.require_no_loss(path, localizer, overwrite)
    keyframes = _keyframes_of(localizer)
    # Neither file takes its name before both are written.
    with atomic_write(LOCALIZER.file(path)) as aside:
        LOCALIZER.write(aside, localizer)
        if keyframes is None:
            archived = KEYFRAMES.archive(path)
            return f'{LOCALIZER.file(path)}{f": {archived}" if archived else ""}'
        KEYFRAMES.save(path, keyframes)
    return f'{LOCALIZER.file(path)} and {KEYFRAMES.ending}'


def _keyframes_of(localizer: AnyLocalizer | None) -> SavedKeyframes | None:
    """The keyframes of a map that is made of such; its local map is complete with them.

    Without those of which later visits show the place as well.
    """
    if not isinstance(localizer, Localizer):
        return None
    localizer.complete_map()
    keyframes = localizer.saved_keyframes()
    return None if keyframes is None else reduced(keyframes)


def _tag_of(localizer: AnyLocalizer | None) -> str:
    return localizer.map_tag if isinstance(localizer, Localizer) else ''


@dataclass(frozen=True, eq=False)
class SessionMap:
    """What a session holds of a map. localizer: None where there is none in it.

    tag: of the storey, where the localizer does not know it.
    """

    grid: OccupancyGrid
    topology: TopologyBuilder
    regions: RegionTracker
    edits: MapEdits
    localizer: AnyLocalizer | None = None
    tag: str = ''


def save_session(path: str, session: SessionMap) -> list[str]:
    """Write a session, all files or none; returns what was written, a line each.

    What an earlier session of that name has besides is archived. Raises InputError where a file of
    another program, or a map by an empty one, would be replaced, OSError where the disk is full.
    """
    require_own_files(path, GRID)
    parts: list[tuple[SessionPart[Any, Any], _HasState | None]] = [
        (TOPOLOGY, session.topology),
        (REGIONS, session.regions),
        (KEYFRAMES, _keyframes_of(session.localizer)),
        (LOCALIZER, session.localizer),
        (EXPLORATION, None),
    ]
    written = [(part, value) for part, value in parts if value is not None]
    with uninterrupted():
        with ExitStack() as stack:
            for part, value in written:
                part.write(stack.enter_context(atomic_write(part.file(path))), value)
            tag = _tag_of(session.localizer) or session.tag
            grid = save_grid(path, session.grid, edits=session.edits, tag=tag)
        archived = [part.archive(path) for part, value in parts if value is None]
    return _said(grid, [part for part, _ in written], archived)


def copy_map(path: str, to: str) -> list[str]:
    """Copy all of a session but its exploration under another name, all files or none.

    Returns what was written, and raises, as `save_session`.
    """
    require_own_files(to, GRID)
    parts = (TOPOLOGY, REGIONS, KEYFRAMES, LOCALIZER, EXPLORATION)
    copied = [part for part in parts if part is not EXPLORATION and part.exists(path)]
    with uninterrupted():
        with ExitStack() as stack:
            for part in copied:
                aside = stack.enter_context(atomic_write(part.file(to)))
                copyfile(part.file(path), aside)
            # Not copied: the description of the map names its image.
            grid = save_grid(to, load_grid(path), edits=load_edits(path), tag=load_tag(path))
        archived = [part.archive(to) for part in parts if part not in copied]
    return _said(grid, copied, archived)


def _said(
    grid: str, written: Sequence[SessionPart[Any, Any]], archived: Sequence[str]
) -> list[str]:
    """Lines on what was written beside a grid, and on what was archived."""
    *endings, last = [part.ending for part in written]
    return [f'{grid}, {", ".join(endings)} and {last}', *filter(None, archived)]


def load_localizer(
    path: str, config: StartConfig, folder: Path | None = None, report: Report = warn
) -> AnyLocalizer | None:
    """Localizer in the map of a session, or in its grid: any map_server map.

    One that maps by scan matching has the keyframes of the session, if there are any.
    folder, report: as in `read_map`. None: no map that this localizer can use.
    Raises InputError where a file is broken, the path names no map, or one of another storey.
    """
    if LOCALIZER.exists(path):
        localizer = _load_own_localizer(path, config)
    elif isinstance(config, LocalizerConfig):
        grid = load_grid(path, None, folder, report)
        localizer = Localizer.in_occupancy_map(grid.known_area(), config)
    else:
        return None
    if isinstance(localizer, Localizer):
        localizer.tag_map(_given_tag(path))
    return localizer


def _load_own_localizer(path: str, config: StartConfig) -> AnyLocalizer:
    if not (isinstance(config, LocalizerConfig) and config.is_mapping):
        return LOCALIZER.load(path, config)
    keyframes = KEYFRAMES.load_optional(path)

    def read(state: State) -> AnyLocalizer:
        _require_own_map(state, config)
        return Localizer.from_state(state, config, keyframes)

    return _read_localizer(path, read)


def load_tag(path: str) -> str:
    """The tag of the storey of a session or map_server map; '' for none. Raises InputError."""
    given = _given_tag(path)
    return _read_localizer(path, tag_of) if LOCALIZER.exists(path) and not given else given


def load_cells(path: str) -> LocalMapConfig:
    """The cells of the local map of a session; those of any new one where it has none.

    Raises InputError.
    """
    return _read_localizer(path, _cells_of) if LOCALIZER.exists(path) else LocalMapConfig()


def _cells_of(state: State) -> LocalMapConfig:
    if 'cell_m' not in state:  # line features
        return LocalMapConfig()
    own = {'cell_m': state['cell_m']}
    checked = snapshot.validate(own, {'cell_m': local_map.FIELDS['cell_m']}, 'local map')
    return LocalMapConfig(resolution_m=float(checked['cell_m']))


def _read_localizer(path: str, read: Callable[[State], Read]) -> Read:
    """What is read of the arrays in STEM.slam.npz, of any localizer."""
    part: SessionPart[Any, Any] = LOCALIZER
    found: Read = replace(part, restore=lambda state, _: read(state)).load(path)
    return found


def _given_tag(path: str) -> str:
    """The tag in STEM.yaml."""
    description = description_of(path)
    return read_tag(description) if _exists(description) else ''


def load_topology(path: str, config: TopologyConfig | None = None) -> TopologyBuilder:
    """Read STEM.topology.npz.

    Raises InputError as `SessionPart.load`, and where the map beside it has another resolution.
    """
    builder = TOPOLOGY.load(path, config)
    description = _with_ending(stem_of(path), _MAP_ENDING)
    own_m = builder.resolution_m
    if own_m is None or not _exists(description):
        return builder
    map_m = read_resolution(description)
    if abs(map_m - own_m) > 1e-6:
        file = TOPOLOGY.file(path)
        raise InputError(f'{file}: made from {own_m} m a cell: expected {map_m} m as the map')
    return builder


def _with_ending(stem: Path, ending: str) -> Path:
    return stem.with_name(stem.name + ending)


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError as error:
        raise InputError(f'{path}: {error.strerror or error}') from error
