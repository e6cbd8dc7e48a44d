"""Pages of experiment results in HTML and Markdown, from the files in their folders."""

import json
from html import escape
from pathlib import Path
from typing import Any

from thinmap_ros.evaluation.parallel_jobs import Report, provenance
from thinmap_ros.files.safe import read_text, write_text
from thinmap_ros.view.figures import write_small_png

_STYLE = """
body { font: 15px/1.5 sans-serif; max-width: 70em; margin: 2em auto; padding: 0 1em; }
img { max-width: 100%; } figure { margin: 1.5em 0; } figcaption { color: #444; }
table { border-collapse: collapse; margin: 1em 0; }
td, th { border: 1px solid #bbb; padding: 0.3em 0.6em; text-align: left; }
.no { background: #fde0d0; } .yes { background: #e0f2ea; }
"""
_VERDICTS = {True: 'yes', False: 'no', None: ''}


def read_about(out: Path, name: str) -> Report:
    """Description of an experiment, from its folder."""
    about: Report = json.loads(read_text(out / name / 'about.json'))
    return about


def write_page(out: Path, names: list[str]) -> Path:
    """Write index.html over the experiments in a folder; returns its path."""
    sections = [_section(name, read_about(out, name)) for name in names]
    links = ''.join(
        f'<li><a href="#{name}">{escape(read_about(out, name)["title"])}</a></li>' for name in names
    )
    text = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<title>thinmap: experiments of the papers</title><style>{_STYLE}</style></head><body>\n'
        f'<h1>Experiments of the papers</h1>\n<ul>{links}</ul>\n'
        + '\n'.join(sections)
        + '\n</body></html>\n'
    )
    write_text(out / 'index.html', text)
    return out / 'index.html'


def _section(name: str, about: Report) -> str:
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
        + (', times: differ from run to run)' if table['timed'] else ')')
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
    head = (
        '<tr><th>quantity</th><th>paper</th><th>thinmap</th><th>confirmed</th><th>remark</th></tr>'
    )
    return f'<table>{head}{"".join(rows)}</table>'


_HEAD = """\
# Experiments of the papers

{provenance}

{chart}`scripts/experiment all --docs docs` runs all experiments and generates this page. The robots
are simulated with realistic noise. The last section replays logs of real robots. The same seed
gives the same numbers, except for times. `scripts/experiment NAME` runs one experiment. With
`--from-bag bags` it reads the recorded drives instead of the simulator; poses agree within 1 mm.

Papers: 1 thinning-based topological maps, 2 exploration by position probability, 3 EKF-SLAM with
topological information. The column *confirmed* compares the result with that of the paper; it is
empty if the paper gives no number.
"""
_OPENING = ('strategies', 'distance')
# Experiment and comparison that decide about a claim, the claim, and a note.
_CLAIMS = (
    (
        'thinning_voronoi',
        'CPU time',
        'Thinning needs less computation than the Voronoi diagram.',
        'Whole floors: section `voronoi` of [Speed](speed.md).',
    ),
    (
        'thinning_voronoi',
        'additional nodes of thinning, laboratory',
        'Thinning makes additional nodes.',
        'With equal pruning, merging and corner nodes, both methods have about as many nodes.',
    ),
    (
        'convergence',
        'steps until one position is left',
        'Global localization converges to one position.',
        '',
    ),
    (
        'exploration',
        'coverage',
        'Exploration by position probability, as the paper prints it, covers the environment.',
        'This is the room of 10 x 10 m. In larger buildings the strategy `paper` stops early; the '
        'calibrated belief of `position_probability` covers them: [Exploration](exploration.md).',
    ),
    (
        'strategies',
        'against visit all end nodes',
        'Position probability is more efficient than to visit all end nodes.',
        'With the calibrated belief.',
    ),
    (
        'strategies',
        'against nearest frontier',
        'Position probability is more efficient than the nearest frontier.',
        'With the calibrated belief, in three small worlds.',
    ),
    (
        'feature_count',
        'EKF-SLAM/TI',
        'The time of a step of EKF-SLAM/TI is nearly constant.',
        'With few features, the conventional filter takes as long.',
    ),
    (
        'feature_count',
        'difference of the estimates',
        'Both filters have almost identical estimates.',
        '',
    ),
)


def write_markdown(out: Path, names: list[str], docs: Path) -> Path:
    """Write results/papers.md over the experiments in a folder, and their figures.

    Returns its path.
    """
    parts = [_HEAD.format(provenance=provenance(out), chart=_first_chart(out, names))]
    parts += _claims(out, names)
    for name in names:
        about = read_about(out, name)
        parts.append(f'## {about["title"]}\n\n*{about["source"]}.* {about["how"]} (`{name}`)\n')
        if about['comparisons']:
            parts.append(_markdown_rows(about['comparisons']))
        for plot in about['plots']:
            write_small_png(out / name / f'{plot["name"]}.png', docs / _picture(name, plot))
            parts.append(_figure(name, plot))
    page = docs / 'results' / 'papers.md'
    write_text(page, '\n'.join(parts))
    return page


def _first_chart(out: Path, names: list[str]) -> str:
    """Markdown of the chart that the page opens with: strategies beside each other; or nothing."""
    name, wanted = _OPENING
    plots = read_about(out, name)['plots'] if name in names else []
    return ''.join(f'{_figure(name, plot)}\n' for plot in plots if plot['name'] == wanted)


def _picture(name: str, plot: dict[str, Any]) -> str:
    return f'images/papers/{name}_{plot["name"]}.png'


def _figure(name: str, plot: dict[str, Any]) -> str:
    return f'![{plot["caption"]}](../{_picture(name, plot)})\n\n*{plot["caption"]}*\n'


def _markdown_rows(comparisons: list[dict[str, Any]]) -> str:
    rows = ['| quantity | paper | thinmap | confirmed | remark |', '|---|---|---|---|---|']
    for c in comparisons:
        cells = [str(c[key]).replace('|', '/') for key in ('what', 'paper', 'ours')]
        rows.append(f'| {" | ".join(cells)} | {_VERDICTS[c["met"]]} | {c["remark"]} |')
    return '\n'.join(rows) + '\n'


def _claims(out: Path, names: list[str]) -> list[str]:
    """Section on the claims of the papers that the experiments decide; empty without any."""
    met = {
        (name, comparison['what']): comparison['met']
        for name in names
        for comparison in read_about(out, name)['comparisons']
    }
    rows = [
        f'| {claim} | {_VERDICTS[met[name, what]]} | {note} |'
        for name, what, claim, note in _CLAIMS
        if (name, what) in met
    ]
    if not rows:
        return []
    head = ['## Claims of the papers\n', '| claim | confirmed | note |', '|---|---|---|']
    return ['\n'.join([*head, *rows]) + '\n']
