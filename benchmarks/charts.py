"""Charts of the results pages: one row for each program or case, one colour for each meaning."""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use('svg')
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from thinmap_ros.evaluation.slam_run import Origin, Range
from thinmap_ros.files.safe import write_text

OURS = '#0072B2'
OTHERS = {Origin.TEAM: '#555555', Origin.PUBLISHED: '#E69F00'}
BAD = '#D55E00'
DOCS = Path(__file__).resolve().parents[1] / 'docs'
_ROW_INCHES = 0.27
_AXIS_INCHES = 0.8
_LEGEND_INCHES = 0.35
_DATA_INCHES = 3.2  # width of the data of a panel, beside the names of its rows
_SHARED_INCHES = 1.9  # where panels share those names: what lets three of them fill a page
_LETTER_INCHES = 0.075


@dataclass(frozen=True)
class Mark:
    """A value in a row, with an interval from low to high; is_filled: of a live pose, or alike."""

    row: str
    value: float
    colour: str = OURS
    low: float | None = None
    high: float | None = None
    is_filled: bool = True


@dataclass(frozen=True, eq=False)
class Panel:
    """A chart of rows in the order of their marks; limit: a vertical line to compare with."""

    title: str
    axis: str
    marks: Sequence[Mark]
    is_log: bool = False
    limit: float | None = None


Key = tuple[str, str, bool]  # of the legend: text, colour, is_filled


def span(row: str, values: Range, colour: str, is_filled: bool = True) -> Mark:
    """Mark of a range: its middle, with an interval if it has a width."""
    low, high = values
    if low == high:
        return Mark(row, low, colour, is_filled=is_filled)
    return Mark(row, 0.5 * (low + high), colour, low, high, is_filled)


def picture(name: str, caption: str) -> str:
    """Markdown of a chart in a page of docs/results."""
    return f'![{caption}](../images/results/{name}.svg)\n\n*{caption}*\n'


def draw(path: Path, panels: Sequence[Panel], keys: Sequence[Key] = (), columns: int = 3) -> None:
    """Write panels in columns, with a legend below, as an SVG file.

    Panels of one line that have the same rows share their names.
    """
    across = min(columns, len(panels))
    lines = math.ceil(len(panels) / across)
    rows = max(len(_rows(panel)) for panel in panels)
    names = _LETTER_INCHES * max(len(row) for panel in panels for row in _rows(panel))
    is_shared = lines == 1 < across and all(_rows(p) == _rows(panels[0]) for p in panels)
    width = names + across * _SHARED_INCHES if is_shared else across * (names + _DATA_INCHES)
    height = lines * (_ROW_INCHES * rows + _AXIS_INCHES) + _LEGEND_INCHES
    with plt.rc_context({'font.size': 9, 'svg.hashsalt': 'thinmap', 'svg.fonttype': 'none'}):
        figure, grid = plt.subplots(
            lines, across, figsize=(width, height), squeeze=False, sharey=is_shared
        )
        for axes, panel in zip(grid.flat, panels, strict=False):
            _draw_panel(axes, panel)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        figure.tight_layout(rect=(0.0, _LEGEND_INCHES / height, 1.0, 1.0))
        handles = [_handle(*key) for key in keys]
        figure.legend(handles=handles, loc='lower center', ncols=len(keys), frameon=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={'Date': None})
        plt.close(figure)


def _rows(panel: Panel) -> list[str]:
    return list(dict.fromkeys(mark.row for mark in panel.marks))


def _draw_panel(axes: Axes, panel: Panel) -> None:
    rows = _rows(panel)
    for mark in panel.marks:
        y = rows.index(mark.row)
        if mark.low is not None and mark.high is not None:
            axes.plot([mark.low, mark.high], [y, y], '-', color=mark.colour, linewidth=2.0)
        axes.plot(mark.value, y, color=mark.colour, **_style(mark.colour, mark.is_filled))
    if panel.limit is not None:
        axes.axvline(panel.limit, color=OURS, linewidth=1.0, zorder=0)
    if panel.is_log:
        axes.set_xscale('log')
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axes.xaxis.set_major_formatter('{x:g}')
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_yticks(range(len(rows)), rows)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.grid(axis='x', color='#dddddd', linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[['top', 'right']].set_visible(False)
    axes.set_title(panel.title, loc='left', fontsize=9, fontweight='bold')
    axes.set_xlabel(panel.axis)


def _handle(text: str, colour: str, is_filled: bool) -> Line2D:
    return Line2D([], [], color=colour, label=text, linestyle='', **_style(colour, is_filled))


def _style(colour: str, is_filled: bool) -> dict[str, Any]:
    """Style of a marker: a disc, or a ring that leaves a disc at the same place visible."""
    face = colour if is_filled else 'none'
    return {'marker': 'o', 'markersize': 6 if is_filled else 9, 'markerfacecolor': face}


def write_page(
    path: Path, text: str, panels: Sequence[Panel], keys: Sequence[Key] = (), columns: int = 3
) -> Path:
    """Write a page of docs/results, and the chart of its name. Returns its path."""
    draw(path.parents[1] / 'images' / 'results' / f'{path.stem}.svg', panels, keys, columns)
    write_text(path, text)
    return path


def page_program(write: Callable[[Path, Path], Path]) -> None:
    """Write a page of a folder of results; words of the command line: it, and that of the pages."""
    results, *docs = map(Path, sys.argv[1:])
    print(write(results, docs[0] if docs else DOCS))
