"""Hooks of mkdocs.yml: formulas as MathML, pages for linked files, names in tables that break."""

import html
import posixpath
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
# Files of the project that are a part of a page of the site.
_INCLUDED = {
    'README.md': 'index.md',
    'CONTRIBUTING.md': 'development/contributing.md',
    'CHANGELOG.md': 'development/changelog.md',
}
_LINK = re.compile(r'(?<=\]\()([^()\s#]+)(?=[)#])')
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_CELL = re.compile(r'<td[^>]*>.*?</td>', re.DOTALL)
_CODE = re.compile(r'(?<=<code>)[^<]*')
_LANGUAGES = {'.py': 'python', '.yaml': 'yaml', '.sh': 'bash', '.toml': 'toml', '': 'text'}


def _page_of(name: str) -> str:
    """Page of the site for a file of the project, both from their root folders."""
    if name.startswith('docs/'):
        return name.removeprefix('docs/')
    return _INCLUDED.get(name, f'source/{name}.md')


def _linked(text: str, folder: str) -> dict[str, str]:
    """Links of a text in a folder of the project to files of the project outside docs/."""
    found = {}
    for link in _LINK.findall(text):
        name = posixpath.normpath(posixpath.join(folder, link))
        if not name.startswith(('docs/', '..')) and (ROOT / name).is_file():
            found[link] = name
    return found


def on_config(config: Any) -> Any:
    """Say the version on each page."""
    version = re.search(r'<version>(.+)</version>', (ROOT / 'package.xml').read_text())
    assert version is not None
    config.site_name += f' {version[1]}'
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the icon of the web page, and pages for files of the project that pages link to."""
    icon = (ROOT / 'thinmap_ros' / 'web' / 'page' / 'icon.svg').read_text()
    files.append(File.generated(config, 'images/icon.svg', content=icon))
    texts = [(f'docs/{file.src_uri}', file.content_string) for file in files.documentation_pages()]
    texts += [(name, (ROOT / name).read_text()) for name in _INCLUDED if (ROOT / name).exists()]
    names = {n for path, text in texts for n in _linked(text, posixpath.dirname(path)).values()}
    for name in sorted(names - _INCLUDED.keys()):
        text = (ROOT / name).read_text()
        language = _LANGUAGES.get(Path(name).suffix, 'text')
        content = f'# `{name}`\n\n``````{language}\n{text}\n``````\n'
        files.append(File.generated(config, _page_of(name), content=content))
    return files


def on_page_markdown(text: str, page: Any, **_: Any) -> str:
    """Lead links to files of the project to their pages."""
    folder = posixpath.dirname(f'docs/{page.file.src_uri}')
    here = posixpath.dirname(page.file.src_uri)
    linked = _linked(text, folder)
    return _LINK.sub(
        lambda match: (
            posixpath.relpath(_page_of(linked[match[0]]), here or '.')
            if match[0] in linked
            else match[0]
        ),
        text,
    )


def on_page_content(text: str, **_: Any) -> str:
    """Replace formulas in LaTeX by MathML, which browsers show without a script."""
    return _CELL.sub(_with_breaks, _FORMULA.sub(_mathml, text))


def _mathml(match: re.Match[str]) -> str:
    formula = html.unescape(match[3])
    if match[2] == '(':
        return str(convert(formula))
    return f'<div class="formula">{convert(formula, display="block")}</div>'


def _with_breaks(cell: re.Match[str]) -> str:
    """Allow a line break after each part of a name in a cell of a table."""
    return _CODE.sub(lambda code: re.sub(r'(?<=\w[_/.])(?=\w)', '<wbr>', code[0]), cell[0])
