"""A run as one HTML page beside its report.json: figures, picture, missing area, files, command.

The page needs no other file, as pictures are part of it, and runs no script.
"""

import base64
import html
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from thinmap_ros.core.exploration.belief import WORTH_SEEING_M2
from thinmap_ros.files.safe import write_text
from thinmap_ros.view.plot_writer import drawn
from thinmap_ros.view.plots import run_plot

_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff;
  max-width: 56rem; margin: 0 auto; padding: 1rem; overflow-wrap: anywhere; }
h1 { font-size: 1.4rem; line-height: 1.25; }
h2 { font-size: 1.1rem; margin: 1.6rem 0 .4rem; }
table { border-collapse: collapse; width: 100%; }
td, th { text-align: left; vertical-align: top; padding: .25rem .6rem .25rem 0;
  border-bottom: 1px solid #ddd; font-weight: normal; }
th { color: #555; }
td:first-child code { white-space: nowrap; }
code, pre { font: 0.9em/1.5 ui-monospace, monospace; background: #f3f3f3; border-radius: 3px; }
code { padding: .1em .3em; }
pre { padding: .6rem; white-space: pre-wrap; margin: 0; }
.picture { overflow-x: auto; }
.picture input { position: absolute; opacity: 0; }
.picture img { max-width: 100%; }
.picture label img { cursor: zoom-in; }
.picture input:checked + label img { max-width: none; cursor: zoom-out; }
.picture input:focus-visible + label img { outline: 2px solid #0072B2; }
small { color: #555; }
"""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src {images}; style-src 'unsafe-inline'">
<title>{title}</title>
<style>{style}</style>
</head>
<body class="{kind}">
<h1>{title}</h1>
{content}
</body>
</html>
"""


@dataclass(frozen=True)
class Page:
    """Title, as text, and content, as HTML.

    images: sources from which the browser takes pictures (Content-Security-Policy); style, kind:
    rules of CSS beyond the common ones, and the class of the body that they name.
    """

    title: str
    content: str
    images: str
    style: str = ''
    kind: str = 'run'


def write_page(path: Path, page: Page) -> Path:
    """Write a page as a whole or not at all; returns its path."""
    text = _PAGE.format(
        title=html.escape(page.title),
        images=page.images,
        style=_STYLE + page.style,
        kind=page.kind,
        content=page.content,
    )
    write_text(path, text)
    return path


NAME = 'report.html'
_PICTURE = 'summary.png'
_MAX_PLACES = 20


@dataclass(frozen=True)
class _Figure:
    """A row of the table: keys in the report, label, unit, factor to that unit, decimals."""

    keys: tuple[str, ...]
    label: str
    unit: str = ''
    factor: float = 1.0
    decimals: int = 0


# In the order of the table. A report has some of them.
_FIGURES = (
    _Figure(('reason',), 'End of the exploration'),
    _Figure(('ended_by',), 'Ended early by'),
    _Figure(('coverage',), 'Area seen', '%', 100.0, 1),
    _Figure(('scans',), 'Scans'),
    _Figure(('skipped',), 'Records skipped'),
    _Figure(('first_skipped',), 'First record skipped'),
    _Figure(('without_odometry',), 'Scans without odometry'),
    _Figure(('blind',), 'Blind scans'),
    _Figure(('misaligned',), 'Scans of a misaligned laser'),
    _Figure(('lost',), 'Scans of a lost robot'),
    _Figure(('apart',), 'Scans mapped apart'),
    _Figure(('refused',), 'Scans not mapped'),
    _Figure(('first_refused',), 'First scan not mapped'),
    _Figure(('warnings',), 'Warnings'),
    _Figure(('distance',), 'Path length', 'm', 1.0, 1),
    _Figure(('distance_at', '0.99'), 'Path length to 99 % seen', 'm', 1.0, 1),
    _Figure(('time',), 'Simulated time', 's'),
    _Figure(('collisions',), 'Collisions'),
    _Figure(('joins',), 'Maps joined'),
    _Figure(('pose_rmse',), 'Position error (RMS)', 'cm', 100.0, 1),
    _Figure(('pose_rmse_aligned',), 'Position error after alignment (RMS)', 'cm', 100.0, 1),
    _Figure(('heading_rmse_deg',), 'Heading error (RMS)', 'deg', 1.0, 2),
    _Figure(('end_nodes_seen',), 'End nodes found'),
    _Figure(('end_nodes_visited',), 'End nodes visited'),
    _Figure(('loops_closed',), 'Loops closed'),
    _Figure(('nodes',), 'Graph nodes'),
    _Figure(('edges',), 'Graph edges'),
    _Figure(('strategy',), 'Strategy'),
    _Figure(('options', 'localization'), 'Localization'),
    _Figure(('cpu_ms_per_scan',), 'CPU time per scan, whole program', 'ms', 1.0, 1),
    _Figure(('ms_per_scan', 'all', 'median'), 'CPU time of pose and map, median', 'ms', 1.0, 1),
    _Figure(
        ('ms_per_scan', 'all', 'p95'), 'CPU time of pose and map, 95th percentile', 'ms', 1.0, 1
    ),
    _Figure(('wall_s',), 'Elapsed time', 's', 1.0, 1),
    _Figure(('peak_mb',), 'Peak memory', 'MB'),
)

_FILES = {
    'summary.png': 'this picture',
    'map.yaml': 'occupancy map for map_server: resolution, origin and thresholds',
    'map.pgm': 'cells of that map',
    'topology.geojson': 'route graph with regions and doors, for the Nav2 route server',
    'trajectory.tum': 'pose at the time of each scan (TUM format)',
    'trajectory_final.tum': 'the same poses after all corrections',
    'true_trajectory.tum': 'true poses of the simulated robot, in the same frame',
    'report.json': 'all figures',
    'recording.rrd': 'recording for the rerun viewer: rerun recording.rrd',
    'bag': 'rosbag2 of all topics',
    'log': 'output of each node',
    'result.json': 'result of the action explore',
}


def write(folder: Path, title: str, report: Mapping[str, Any], command: str) -> Path:
    """Write report.html into a folder that holds all other results of a run; returns its path."""
    files = {path.name for path in folder.iterdir()}
    sections = [
        ('', _table(_rows(report))),
        ('', _picture(folder / _PICTURE)),
        ('', _curves(report)),
        ('What is missing', _missing(report)),
        ('Files', _file_table(files)),
        ('Command', f'<pre>{html.escape(command)}</pre>'),
    ]
    text = '\n'.join(
        (f'<h2>{heading}</h2>\n' if heading else '') + content
        for heading, content in sections
        if content
    )
    return write_page(folder / NAME, Page(title, text, images='data:'))


def _rows(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Label, and value with unit, of each figure that the report has."""
    rows = []
    for figure in _FIGURES:
        value = _value_of(report, figure.keys)
        if isinstance(value, list):
            value = '; '.join(value)
        if value is None or value == '':
            continue
        if not isinstance(value, str):
            value = f'{figure.factor * value:.{figure.decimals}f} {figure.unit}'.strip()
        rows.append((figure.label, value))
    return rows


def _value_of(report: Mapping[str, Any], keys: tuple[str, ...]) -> Any:
    value: Any = report
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _table(rows: Iterable[tuple[str, str]]) -> str:
    lines = [
        f'<tr><th>{html.escape(label)}</th><td>{html.escape(value)}</td></tr>'
        for label, value in rows
    ]
    return '<table>\n' + '\n'.join(lines) + '\n</table>'


def _picture(path: Path) -> str:
    """The picture, which a click enlarges; nothing if there is none."""
    if not path.exists():
        return ''
    data = base64.b64encode(path.read_bytes()).decode()
    return (
        '<p class="picture"><input type="checkbox" id="zoom"><label for="zoom">'
        '<img alt="Map, graph and path" title="Click to enlarge"'
        f' src="data:image/png;base64,{data}"></label></p>'
    )


def _curves(report: Mapping[str, Any]) -> str:
    """Curves of the report; nothing if it has none."""
    plot = run_plot(report)
    if plot is None:
        return ''
    data = base64.b64encode(drawn(plot, ['svg'])[0]).decode()
    names = ' and '.join(panel.title for panel in plot.panels)
    return f'<p class="picture"><img alt="{names}" src="data:image/svg+xml;base64,{data}"></p>'


def _missing(report: Mapping[str, Any]) -> str:
    """What the exploration has probably not seen; nothing if the report has no such estimate."""
    if 'missing_area' not in report:
        return ''
    missing = report['missing_area']
    if missing is None:
        return '<p>This strategy does not estimate the unseen area.</p>'
    text = (
        f'<p>Expected unseen area: {missing["expected_m2"]:.1f} m², '
        f'95 % bound: {missing["bound_95_m2"]:.1f} m².</p>'
    )
    places = missing['places']
    if not places:
        return (
            text + f'\n<p>No single place is expected to hide {WORTH_SEEING_M2:g} m² or more.</p>'
        )
    rows = [
        (f'({place["x"]:.2f}, {place["y"]:.2f}) m', f'{place["expected_m2"]:.1f} m²')
        for place in places[:_MAX_PLACES]
    ]
    more = len(places) - len(rows)
    return text + '\n' + _table(rows) + (f'\n<p>And {more} more places.</p>' if more else '')


def _file_table(names: set[str]) -> str:
    lines = [
        f'<tr><td><a href="{html.escape(name)}"><code>{html.escape(name)}</code></a></td>'
        f'<td>{html.escape(content)}</td></tr>'
        for name, content in _FILES.items()
        if name in names
    ]
    return '<table>\n' + '\n'.join(lines) + '\n</table>'


_TABLE_STYLE = """
.many { max-width: none; }
.many th, .many td { white-space: nowrap; }
.many td:last-child { white-space: normal; }
figure { display: inline-block; width: 18rem; margin: .5rem; vertical-align: top; }
figure img { width: 100%; }
"""

_CONTENT = """<table>
<tr>{head}</tr>
{rows}
</table>
{figures}
<h2>Command</h2>
<pre>{command}</pre>"""


@dataclass(frozen=True)
class Entry:
    """Folder of the results of a file, and its row of the table."""

    folder: Path
    row: Sequence[Any]


def write_batch(
    folder: Path, title: str, columns: Sequence[str], entries: Sequence[Entry], command: str
) -> Path:
    """Write report.html over folders of results beside it: a table and their pictures."""
    content = _CONTENT.format(
        head=''.join(f'<th>{html.escape(column)}</th>' for column in columns),
        rows='\n'.join(_table_row(folder, entry) for entry in entries),
        figures='\n'.join(_figure(folder, e) for e in entries if (e.folder / _PICTURE).exists()),
        command=html.escape(command),
    )
    page = Page(title, content, images="'self' file:", style=_TABLE_STYLE, kind='many')
    return write_page(folder / NAME, page)


def _table_row(folder: Path, entry: Entry) -> str:
    first, *others = (html.escape(str(value)) for value in entry.row)
    page = entry.folder / NAME
    linked = f'<a href="{_url(folder, page)}">{first}</a>' if page.exists() else first
    return f'<tr><td>{linked}</td>{"".join(f"<td>{value}</td>" for value in others)}</tr>'


def _figure(folder: Path, entry: Entry) -> str:
    name = html.escape(entry.folder.name)
    picture = _url(folder, entry.folder / _PICTURE)
    image = f'<img src="{picture}" alt="Map of {name}" loading="lazy">'
    return f'<figure><a href="{picture}">{image}</a><figcaption>{name}</figcaption></figure>'


def _url(folder: Path, file: Path) -> str:
    """Address of a file, relative to the page in a folder."""
    return html.escape(quote(os.path.relpath(file, folder.absolute())))
