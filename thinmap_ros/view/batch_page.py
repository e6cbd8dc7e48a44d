"""Results of many files as one HTML page: a table, and the picture of each with its own page."""

import html
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from thinmap_ros.view import html_page, report_page

_PICTURE = 'summary.png'
_STYLE = """
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


def write(
    folder: Path, title: str, columns: Sequence[str], entries: Sequence[Entry], command: str
) -> Path:
    """Write report.html over folders of results beside it; returns its path."""
    content = _CONTENT.format(
        head=''.join(f'<th>{html.escape(column)}</th>' for column in columns),
        rows='\n'.join(_table_row(folder, entry) for entry in entries),
        figures='\n'.join(_figure(folder, e) for e in entries if (e.folder / _PICTURE).exists()),
        command=html.escape(command),
    )
    page = html_page.Page(title, content, images="'self' file:", style=_STYLE, kind='many')
    return html_page.write(folder / report_page.NAME, page)


def _table_row(folder: Path, entry: Entry) -> str:
    first, *others = (html.escape(str(value)) for value in entry.row)
    page = entry.folder / report_page.NAME
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
