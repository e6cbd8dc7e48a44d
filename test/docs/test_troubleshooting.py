"""Each message that docs/how_to/troubleshooting.md quotes is in the source code."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / 'docs' / 'how_to' / 'troubleshooting.md'
ANYTHING = '...'  # a name or number in a message of the page
VALUE = '\0'  # the same in the source


def literals() -> list[str]:
    """Strings of the package, with VALUE for each value in them."""
    found = []
    for path in (ROOT / 'thinmap_ros').rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                parts = (v.value if isinstance(v, ast.Constant) else VALUE for v in node.values)
                found.append(''.join(parts))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def quoted_messages() -> list[str]:
    """Code spans in the first column of the tables that are messages: with a space."""
    rows = re.findall(r'^\| (.+?) \|', PAGE.read_text(), re.MULTILINE)
    return [span for cell in rows for span in re.findall(r'`([^`]+)`', cell) if ' ' in span]


def test_each_quoted_message_is_in_the_source():
    texts = literals()
    messages = quoted_messages()
    assert len(messages) > 40
    for message in messages:
        parts = [re.escape(part) for part in message.split(ANYTHING)]
        pattern = re.compile(f'.*{VALUE}.*'.join(parts))
        assert any(pattern.search(text) for text in texts), f'{message}: no such message'
