"""Links to the page, as another device opens them."""

import socket
from ipaddress import ip_address

from thinmap_ros.web.access import Tokens

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
