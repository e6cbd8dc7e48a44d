"""Pages of experiment results in HTML and Markdown, from the files in their folders."""

import json
from html import escape
from pathlib import Path
from typing import Any

from thinmap_ros.files.atomic import read_text, write_text
from thinmap_ros.view.figures import write_small_png

About = dict[str, Any]
_STYLE = """
body { font: 15px/1.5 sans-serif; max-width: 70em; margin: 2em auto; padding: 0 1em; }
img { max-width: 100%; } figure { margin: 1.5em 0; } figcaption { color: #444; }
table { border-collapse: collapse; margin: 1em 0; }
td, th { border: 1px solid #bbb; padding: 0.3em 0.6em; text-align: left; }
.no { background: #fde0d0; } .yes { background: #e0f2ea; }
"""
_VERDICTS = {True: 'yes', False: 'no', None: ''}


def read_about(out: Path, name: str) -> About:
    """Description of an experiment, from its folder."""
    about: About = json.loads(read_text(out / name / 'about.json'))
    return about


def write_page(out: Path, names: list[str]) -> Path:
    """Write index.html over the experiments in a folder; returns its path."""
    sections = [_section(name, read_about(out, name)) for name in names]
    links = ''.join(
        f'<li><a href="#{name}">{escape(read_about(out, name)["title"])}</a></li>' for name in names
    )
    text = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<title>thinmap: experiments</title><style>{_STYLE}</style></head><body>\n'
        f"<h1>The papers' experiments</h1>\n<ul>{links}</ul>\n"
        + '\n'.join(sections)
        + '\n</body></html>\n'
    )
    write_text(out / 'index.html', text)
    return out / 'index.html'


def _section(name: str, about: About) -> str:
    parts = [
        f'<h2 id="{name}">{escape(about["title"])}</h2>',
        f'<p><b>{escape(about["source"])}</b></p>',
    ]
    parts.append(f'<p>{escape(about["how"])}</p>')
    if about['comparisons']:
        parts.append(_comparisons(about['comparisons']))
    for plot in about['plots']:
        file = f'{name}/{plot["name"]}'
        parts.append(
            f'<figure><a href="{file}.svg">'
            f'<img src="{file}.png" alt="{escape(plot["caption"])}"></a>'
            f'<figcaption>{escape(plot["caption"])}</figcaption></figure>'
        )
    tables = [
        f'<a href="{name}/{table["name"]}.csv">{table["name"]}.csv</a> ({table["rows"]} rows'
        + (', times: not the same from run to run)' if table['timed'] else ')')
        for table in about['tables']
    ]
    return '\n'.join([*parts, f'<p>Tables: {", ".join(tables)}</p>' if tables else ''])


def _comparisons(comparisons: list[dict[str, Any]]) -> str:
    rows = []
    for c in comparisons:
        cells = ''.join(f'<td>{escape(c[key])}</td>' for key in ('what', 'paper', 'ours'))
        verdict = _VERDICTS[c['met']]
        rows.append(
            f'<tr>{cells}<td class="{verdict}">{verdict}</td><td>{escape(c["remark"])}</td></tr>'
        )
    head = '<tr><th>what</th><th>paper</th><th>here</th><th>met</th><th>remark</th></tr>'
    return f'<table>{head}{"".join(rows)}</table>'


_HEAD = """\
# The papers' experiments

Made by `scripts/experiments/all.sh --docs docs` from the files that the experiments leave in
`out/experiments`; the same seed gives the same numbers, but for times. The robots are simulated,
with noise as of real ones, but for the logs at the end. One experiment alone:
`scripts/experiments/NAME.sh`; from the recorded drives, with the same figures (poses within 1 mm):
`scripts/experiments/NAME.sh --from-bag bags`.

Papers: 1 thinning-based topological maps, 2 exploration by position probability, 3 EKF-SLAM with
topological information.
"""


def write_markdown(out: Path, names: list[str], docs: Path) -> Path:
    """Write results/papers.md over the experiments in a folder, and their figures.

    Returns its path.
    """
    parts = [_HEAD]
    for name in names:
        about = read_about(out, name)
        parts.append(f'## {about["title"]}\n\n*{about["source"]}.* {about["how"]} (`{name}`)\n')
        if about['comparisons']:
            parts.append(_markdown_rows(about['comparisons']))
        for plot in about['plots']:
            picture = f'images/papers/{name}_{plot["name"]}.png'
            write_small_png(out / name / f'{plot["name"]}.png', docs / picture)
            parts.append(f'![{plot["caption"]}](../{picture})\n\n*{plot["caption"]}*\n')
    page = docs / 'results' / 'papers.md'
    write_text(page, '\n'.join(parts))
    return page


def _markdown_rows(comparisons: list[dict[str, Any]]) -> str:
    rows = ['| what | paper | here | met | remark |', '|---|---|---|---|---|']
    for c in comparisons:
        cells = [str(c[key]).replace('|', '/') for key in ('what', 'paper', 'ours')]
        rows.append(f'| {" | ".join(cells)} | {_VERDICTS[c["met"]]} | {c["remark"]} |')
    return '\n'.join(rows) + '\n'
