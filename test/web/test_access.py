"""Who may open the page, and what may be done with which link."""

import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.web.access import Gate, Role, Tokens, read_tokens, require_safe_host

TOKENS = Tokens('s' * 20, 'w' * 20)


@pytest.mark.parametrize('host', ['127.0.0.1', '127.3.2.1', '::1'])
def test_this_machine_needs_no_token(host):
    require_safe_host(host, has_tokens=False)


@pytest.mark.parametrize('host', ['0.0.0.0', '192.168.1.5', '::'])
def test_another_address_needs_one(host):
    require_safe_host(host, has_tokens=True)
    with pytest.raises(InputError, match='expected web_token_file'):
        require_safe_host(host, has_tokens=False)


@pytest.mark.parametrize('host', ['', 'localhost', 'robot.lan', '127.0.0.1.example.org'])
def test_a_name_is_no_address(host):
    with pytest.raises(InputError, match='expected an IP address'):
        require_safe_host(host, has_tokens=True)


def test_the_file_is_made_for_its_owner_alone_and_read_again(tmp_path):
    path = tmp_path / 'tokens'
    made = read_tokens(path)
    assert made.is_new and path.stat().st_mode & 0o777 == 0o600
    again = read_tokens(path)
    assert not again.is_new and (again.steer, again.watch) == (made.steer, made.watch)
    assert made.steer != made.watch and len(made.steer) >= 20
    assert read_tokens(tmp_path / 'others').steer != made.steer


@pytest.mark.parametrize(
    ('text', 'mode', 'said'),
    [
        (f'steer {"a" * 16}\nwatch {"b" * 16}\n', 0o644, 'expected a file of mode 0600'),
        (f'steer {"a" * 16}\nwatch {"b" * 15}\n', 0o600, '16 characters or more'),
        (f'steer {"a" * 16}\n', 0o600, 'expected the lines'),
        (f'steer {"a" * 16}\nwatch {"a" * 16}\n', 0o600, 'two different tokens'),
        ('', 0o600, 'expected the lines'),
        ('\xff\x00' * 5000, 0o600, 'expected the lines'),
    ],
)
def test_a_file_that_does_not_protect_is_refused(tmp_path, text, mode, said):
    path = tmp_path / 'tokens'
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(InputError, match=said):
        read_tokens(path)


def test_a_link_to_a_file_is_refused(tmp_path):
    read_tokens(tmp_path / 'real')
    (tmp_path / 'link').symlink_to(tmp_path / 'real')
    with pytest.raises(InputError, match='web_token_file'):
        read_tokens(tmp_path / 'link')
    with pytest.raises(InputError, match='No such file'):
        read_tokens(tmp_path / 'no' / 'folder')


def test_a_token_decides_what_may_be_done():
    gate = Gate(TOKENS)
    assert gate.role(TOKENS.steer) is Role.STEER
    assert gate.role(TOKENS.watch) is Role.WATCH
    for wrong in ('', 's', 's' * 21, TOKENS.steer.upper(), '\ud800', 'ä' * 20):
        assert gate.role(wrong) is None
    assert Gate(None).role('') is Role.STEER


def test_names_that_lead_here_are_not_addresses():
    gate = Gate(None)
    for host in ('127.0.0.1:8480', 'localhost:8480', '[::1]:8480', '127.0.0.1'):
        assert gate.allows_host(host)
    for host in ('evil.example:8480', '127.0.0.1.evil.example', '', '[', '192.168.1.2:8480'):
        assert not gate.allows_host(host)


def test_pages_of_others_open_no_socket():
    gate = Gate(None)
    assert gate.allows_origin('http://127.0.0.1:8480', '127.0.0.1:8480')
    assert gate.allows_origin(None, '127.0.0.1:8480')
    for origin in (
        'http://evil.example',
        'null',
        '',
        'http://127.0.0.1:8481',
        'http://127.0.0.1:84800',
    ):
        assert not gate.allows_origin(origin, '127.0.0.1:8480')
