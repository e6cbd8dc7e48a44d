"""An HTML page that needs no other file, loads nothing from elsewhere and runs no script."""

import html
from dataclasses import dataclass
from pathlib import Path

from thinmap_ros.files.safe import write_text

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
.picture img { max-width: 100%; cursor: zoom-in; }
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


def write(path: Path, page: Page) -> Path:
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
