"""QR codes of links in a terminal. Segno is part of the extra `web`; without it there is none."""

import io

_LIGHT_ON_DARK = '\033[97;40m'
_PLAIN = '\033[0m'


def qr_code(link: str, has_colours: bool = False) -> str:
    """QR code of a link, two modules a character, with its quiet zone; '' without segno.

    has_colours: light on dark, whatever the colours of the terminal are. Without, the terminal has
    to be dark.
    """
    try:
        import segno
    except ImportError:
        return ''
    text = io.StringIO()
    segno.make_qr(link, error='l').terminal(text, compact=True)
    lines = text.getvalue().splitlines()
    if has_colours:
        lines = [f'{_LIGHT_ON_DARK}{line}{_PLAIN}' for line in lines]
    return '\n'.join(lines)
