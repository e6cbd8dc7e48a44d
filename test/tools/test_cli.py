"""Common behaviour of all command line programs."""

import argparse
import sys
from pathlib import Path

import numpy as np
import pytest

from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.logs.log import LaserOptions, Log
from thinmap_ros.logs.readers.bag import BagLog
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser


def ends_with(monkeypatch: pytest.MonkeyPatch, error: BaseException | None) -> object:
    def work(arguments: argparse.Namespace) -> None:
        if error is not None:
            raise error

    monkeypatch.setattr('sys.argv', ['prog'])
    try:
        cli.run(work, argparse.ArgumentParser(prog='prog'))
    except SystemExit as end:
        return end.code
    return 0


@pytest.mark.parametrize(
    ('error', 'code', 'said'),
    [
        (None, 0, ''),
        (InputError('a.log:3: x: expected y'), 2, 'prog: error: a.log:3: x: expected y\n'),
        (ConfigError('several\nlines'), 2, 'prog: error: several lines\n'),
        (
            OSError(28, 'No space left on device'),
            2,
            'prog: error: [Errno 28] No space left on device\n',
        ),
        (KeyboardInterrupt(), 130, 'prog: interrupted\n'),
    ],
)
def test_how_programs_end(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: BaseException | None,
    code: int,
    said: str,
) -> None:
    assert ends_with(monkeypatch, error) == code
    assert capsys.readouterr().err == said


@pytest.mark.parametrize(
    ('words', 'command'),
    [
        (['thinmap replay', 'a b.log', '-o', 'out'], "thinmap replay 'a b.log' -o out"),
        (['/x/thinmap_ros/tools/demo.py', '--view'], 'thinmap demo --view'),
        (['/x/lib/thinmap_ros/replay', 'a.log'], 'thinmap replay a.log'),
    ],
)
def test_the_command_can_be_run_again(
    monkeypatch: pytest.MonkeyPatch, words: list[str], command: str
) -> None:
    monkeypatch.setattr('sys.argv', words)
    assert cli.command_line() == command


def parse(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument('log', type=Path)
    cli.add_log_options(parser)
    return parser.parse_args(words)


def opened(*words: str) -> Log:
    arguments = parse(*words)
    return cli.open_log(arguments.log, arguments)


def test_an_option_that_is_not_given_is_the_configs() -> None:
    assert cli.config_from(parse('a.clf'), LaserOptions) == LaserOptions()
    given = cli.config_from(
        parse('a.clf', '--range-max-m', '25', '--start-angle-deg=-110'), LaserOptions
    )
    assert given == LaserOptions(range_max_m=25.0, start_angle_deg=-110.0)


def test_a_value_out_of_range_is_an_error() -> None:
    with pytest.raises(ConfigError, match='range_max_m'):
        cli.config_from(parse('a.clf', '--range-max-m', '-1'), LaserOptions)


def test_logs_and_bags_are_told_apart(tmp_path: Path) -> None:
    assert isinstance(opened('a.clf'), CarmenLog)
    assert isinstance(opened('a.mcap'), BagLog)
    bag = opened(str(tmp_path), '--scan-topic', '/front', '--base-frame', 'base')
    assert isinstance(bag, BagLog)
    assert (bag.scan_topic, bag.base_frame, bag.T_base_laser) == (('/front',), 'base', None)


def test_several_scan_topics_are_those_of_several_lasers(tmp_path: Path) -> None:
    bag = opened(str(tmp_path), '--scan-topic', '/front', '/rear')
    assert isinstance(bag, BagLog) and bag.scan_topic == ('/front', '/rear')


@pytest.mark.parametrize(
    ('given', 'topics'), [(['/front'], ['/front']), (['/front', '/rear'], ['/front', '/rear'])]
)
def test_a_bag_may_follow_the_scan_topics(
    tmp_path: Path, given: list[str], topics: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[argparse.Namespace] = []
    words = ['replay', '--scan-topic', *given, str(tmp_path), '--odom-topic', '/odom']
    monkeypatch.setattr(sys, 'argv', words)
    parser = Parser('replay', '')
    parser.add_argument('logs', type=Path, nargs='+')
    cli.add_log_options(parser)
    cli.run(found.append, parser)
    assert (found[0].logs, found[0].scan_topic) == ([tmp_path], topics)
    assert found[0].odom_topic == '/odom'


@pytest.mark.parametrize(('word', 'offset'), [('--offset-m=0.78', 0.78), ('--offset-m=0', 0.0)])
def test_an_offset_that_is_given_comes_before_tf_static(
    tmp_path: Path, word: str, offset: float
) -> None:
    bag = opened(str(tmp_path), word)
    assert isinstance(bag, BagLog) and bag.T_base_laser is not None
    assert np.array_equal(bag.T_base_laser, [offset, 0.0, 0.0])
