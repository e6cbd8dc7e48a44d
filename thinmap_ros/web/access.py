"""Who may open the page, and links to it."""

import hmac
import io
import os
import secrets
import socket
import stat
from dataclasses import dataclass
from enum import Enum
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

from thinmap_ros.core.errors import InputError, quoted

_TOKEN_BYTES = 16
_MIN_TOKEN_LENGTH = 16
_MAX_FILE_BYTES = 4096
_OWNER_ONLY = 0o600


class Role(Enum):
    """What a page may do."""

    STEER = 'steer'
    WATCH = 'watch'


@dataclass(frozen=True)
class Tokens:
    """Secrets of the two links: to steer, and to watch only. is_new: made just now."""

    steer: str
    watch: str
    is_new: bool = False


def require_safe_host(host: str, has_tokens: bool) -> None:
    """Raise InputError unless an address is of this machine alone, or tokens are asked for."""
    try:
        address = ip_address(host)
    except ValueError as error:
        raise InputError(f'host {quoted(host)}: expected an IP address') from error
    if not address.is_loopback and not has_tokens:
        raise InputError(
            f'host {host}: others than this machine could steer the robot: '
            'expected web_token_file, too'
        )


def read_tokens(path: Path) -> Tokens:
    """Tokens of a file, which is made where there is none, for its owner alone.

    Raises InputError where others may read it, or it does not hold two tokens.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _OWNER_ONLY)
    except FileExistsError:
        return _read(path)
    except OSError as error:
        raise InputError(f'web_token_file {path}: {error.strerror}') from error
    tokens = Tokens(
        secrets.token_urlsafe(_TOKEN_BYTES), secrets.token_urlsafe(_TOKEN_BYTES), is_new=True
    )
    with os.fdopen(descriptor, 'w') as file:
        file.write(f'steer {tokens.steer}\nwatch {tokens.watch}\n')
    return tokens


def _read(path: Path) -> Tokens:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        raise InputError(f'web_token_file {path}: {error.strerror}') from error
    with os.fdopen(descriptor, 'rb') as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode) or status.st_mode & 0o077:
            mode = stat.filemode(status.st_mode)
            raise InputError(f'web_token_file {path}: {mode}: expected a file of mode 0600')
        text = file.read(_MAX_FILE_BYTES).decode('ascii', errors='replace')
    words = [line.split() for line in text.splitlines()]
    named = {line[0]: line[1] for line in words if len(line) == 2}
    is_whole = named.keys() == {'steer', 'watch'} and len(words) == 2
    if not is_whole or min(map(len, named.values())) < _MIN_TOKEN_LENGTH:
        raise InputError(
            f'web_token_file {path}: expected the lines "steer TOKEN" and "watch TOKEN", '
            f'each token of {_MIN_TOKEN_LENGTH} characters or more'
        )
    if named['steer'] == named['watch']:
        raise InputError(f'web_token_file {path}: expected two different tokens')
    return Tokens(named['steer'], named['watch'])


class Gate:
    """Decides about each page: by its origin, and by the token that it shows.

    Without tokens, who reaches the address of this machine may steer.
    """

    def __init__(self, tokens: Tokens | None) -> None:
        self._tokens = tokens

    def allows_host(self, host: str) -> bool:
        """Whether the page is asked for by an address, and not by a foreign name for it.

        A page of somewhere else whose name is made to lead here (DNS rebinding) has that name.
        """
        if self._tokens is not None:
            return True
        try:
            name = urlsplit(f'//{host}').hostname or ''
        except ValueError:
            return False
        return name == 'localhost' or is_loopback(name)

    def allows_origin(self, origin: str | None, host: str) -> bool:
        """Whether a socket is opened by the page itself; programs give no origin."""
        return origin is None or origin in (f'http://{host}', f'https://{host}')

    def role(self, token: str) -> Role | None:
        """What the holder of a token may do; None: nothing."""
        if self._tokens is None:
            return Role.STEER
        shown = token.encode('utf-8', errors='replace')
        may_steer = hmac.compare_digest(shown, self._tokens.steer.encode())
        may_watch = hmac.compare_digest(shown, self._tokens.watch.encode())
        return Role.STEER if may_steer else Role.WATCH if may_watch else None


def is_loopback(name: str) -> bool:
    """Whether a host is an address of this machine alone."""
    try:
        return ip_address(name).is_loopback
    except ValueError:
        return False


# Addresses that documents use: a route to them is that of the network, and nothing is sent there.
_ELSEWHERE = {4: (socket.AF_INET, '192.0.2.1'), 6: (socket.AF_INET6, '2001:db8::1')}
_PORT = 9


def links(url: str, tokens: Tokens) -> dict[str, str]:
    """Links to steer and to watch at the address of the page."""
    return {'steer': f'{url}#{tokens.steer}', 'watch': f'{url}#{tokens.watch}'}


def reached_host(host: str) -> str:
    """The address by which others reach a server: of one at all addresses, that of the network.

    The host itself where there is no network.
    """
    address = ip_address(host)
    if not address.is_unspecified:
        return host
    family, elsewhere = _ELSEWHERE[address.version]
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((elsewhere, _PORT))
        except OSError:
            return host
        return str(probe.getsockname()[0])


_LIGHT_ON_DARK = '\033[97;40m'
_PLAIN = '\033[0m'


def qr_code(link: str, has_colours: bool = False) -> str:
    """QR code of a link, two modules a character, with its quiet zone; '' without the extra web.

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
