"""The steps of a release: what each runs, and how long it is expected to take."""

import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks.kidnapped.cases import ROWS
from benchmarks.scoreboard.board import KTH, WORLDS

MAX_MINUTES = 360
_LIMIT_FACTOR = 4  # of the expected time: a slower or busier machine
_MIN_LIMIT = 5
_DUNGEONS = ('d1115', 'd114', 'd1573', 'd2191', 'd2555', 'd2720', 'd3088', 'd3486')
_SMALL_FLOORS = ('kth/50052751', 'kth/50052748')
# Expected minutes of the benchmarks of `python -m benchmarks`, and of rows of benchmarks.kidnapped.
_SPEED = {
    'thinning': 2,
    'mapping': 1,
    'graphs': 4,
    'doors': 2,
    'real_maps': 4,
    'compactness': 2,
    'voronoi': 3,
    'online': 3,
    'nodes': 6,
    'localization': 4,
    'matching': 2,
    'planning': 2,
    'long_paths': 5,
    'exploration': 4,
    'slam': 2,
    'pose_graph': 2,
    'growth': 25,
}
_LOCALIZATION_MINUTES = 5


@dataclass(frozen=True)
class Folders:
    """Where a release reads and writes: results, pages, and the folder with logs and worlds."""

    out: Path
    docs: Path
    data: Path


@dataclass(frozen=True)
class Step:
    """A command with the minutes that it is expected to take; needs: steps that come before."""

    name: str
    command: tuple[str, ...]
    minutes: int
    needs: tuple[str, ...] = ()

    @property
    def limit_s(self) -> float:
        """Time after which the step is ended, s."""
        return 60.0 * max(_MIN_LIMIT, _LIMIT_FACTOR * self.minutes)


def steps(folders: Folders) -> list[Step]:
    """All steps in their order: measurements, then pages."""
    measured = [
        *_slam(folders),
        *_speed(folders),
        *_exploration(folders),
        *_localization(folders),
        *_papers(folders),
        *_graphs(folders),
    ]
    return [*measured, *_pages(folders, [step.name for step in measured])]


def _python(module: str, *words: str | Path) -> tuple[str, ...]:
    return (sys.executable, '-m', module, *map(str, words))


def _slam(folders: Folders) -> list[Step]:
    own = ('-o', folders.out / 'slam', '--shared', folders.data.parent)
    board = _python('benchmarks.scoreboard', *own, '--board', '--quiet')
    return [
        Step('slam.board', board, 40),
        Step('slam.stamps', _python('benchmarks.scoreboard.stamps', *own), 3),
    ]


def _speed(folders: Folders) -> list[Step]:
    worlds = ('--worlds', folders.data / 'worlds', '--csv', folders.out / 'speed')
    return [
        Step(f'speed.{name}', _python('benchmarks', name, *worlds), minutes)
        for name, minutes in _SPEED.items()
    ]


def _exploration(folders: Folders) -> list[Step]:
    dungeons = [f'dungeon/{name}' for name in _DUNGEONS]
    ours = ('--strategies', 'position_probability')
    usual = ('position_probability', 'nearest_frontier', 'explore_lite', 'paper', 'bounded_tour')
    pair = ('--strategies', 'position_probability', 'nearest_frontier')
    small = ('--beams', '360', '--field-of-view-deg', '360', '--range-max-m', '3.5')
    by_slam = ('--localization', 'slam', '--starts', '1', *ours)
    belief = _python('benchmarks.exploration.fit_belief', '-o', folders.out / 'belief')
    return [
        _compared(folders, 'random_worlds', dungeons, ('--strategies', *usual), 20),
        _compared(folders, 'floors', _SMALL_FLOORS, ('--strategies', *usual), 20),
        _compared(folders, 'random_world_3.5m', WORLDS[-2:-1], (*pair, *small), 3),
        _compared(folders, 'floor_3.5m', _SMALL_FLOORS[:1], (*pair, *small), 5),
        _compared(folders, 'floors_slam', KTH, by_slam, 10),
        _compared(folders, 'random_world_slam', WORLDS[-2:-1], by_slam, 2),
        Step('exploration.belief', belief, 10),
    ]


def _compared(
    folders: Folders,
    name: str,
    worlds: list[str] | tuple[str, ...],
    words: tuple[str, ...],
    minutes: int,
) -> Step:
    files = [folders.data / 'worlds' / f'{world}.yaml' for world in worlds]
    out = folders.out / 'exploration' / name
    own: tuple[str | Path, ...] = (*files, '-o', out, '--speed-m-s', '0.5', '--quiet')
    return Step(
        f'exploration.{name}',
        _python('thinmap_ros.tools.compare_exploration', *own, *words),
        minutes,
    )


def _localization(folders: Folders) -> list[Step]:
    log = folders.data / 'logs' / 'intel' / 'log.clf'
    words = ('-o', folders.out / 'localization', '--worlds', folders.data / 'worlds', '--log', log)
    return [
        Step(
            f'localization.{row}',
            _python('benchmarks.kidnapped', row, *words),
            _LOCALIZATION_MINUTES,
        )
        for row in ROWS
    ]


def _papers(folders: Folders) -> list[Step]:
    program = 'thinmap_ros.tools.experiment'
    out = ('-o', folders.out / 'papers')
    logs = (*out, '--logs', folders.data / 'logs')
    return [
        Step('papers.experiments', _python(program, 'all', *out), 30),
        Step('papers.logs', _python(program, 'logs', *logs), 5),
    ]


def _graphs(folders: Folders) -> list[Step]:
    """The page of graphs, which are made and measured for it in a minute."""
    maps = folders.data / 'maps'
    page = _python('benchmarks.graphs.real_maps_page', maps, folders.docs)
    return [Step('graphs.page', page, 1)]


def _pages(folders: Folders, measured: list[str]) -> list[Step]:
    out = folders.out
    docs = folders.docs
    explored = [name for name in measured if name.startswith('exploration.')]
    parts = [out / 'exploration' / name.partition('.')[2] for name in explored[:-1]]
    commands = {
        'slam': _python('benchmarks.scoreboard.results_page', out / 'slam', docs),
        'speed': _python('benchmarks.speed.page', out / 'speed', docs),
        'exploration': _python(
            'benchmarks.exploration.page', *parts, out / 'belief', '--docs', docs
        ),
        'localization': _python('benchmarks.kidnapped.page', out / 'localization', docs),
        'papers': _python(
            'thinmap_ros.tools.experiment', 'page', '-o', out / 'papers', '--docs', docs
        ),
    }
    pages = [
        Step(f'page.{name}', command, 1, tuple(n for n in measured if n.startswith(f'{name}.')))
        for name, command in commands.items()
    ]
    pages.append(_page_of(measured, ('slam',), 'peers', folders))
    pages.append(_page_of(measured, ('slam', 'speed', 'localization'), 'targets', folders))
    return pages


def _page_of(measured: list[str], parts: tuple[str, ...], name: str, folders: Folders) -> Step:
    needs = tuple(step for step in measured if step.partition('.')[0] in parts)
    module = f'benchmarks.{name}' if name == 'targets' else f'benchmarks.{name}_page'
    return Step(f'page.{name}', _python(module, folders.out, folders.docs), 1, needs)
