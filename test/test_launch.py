"""The launch file starts `thinmap robot`, with its options."""

import runpy

import pytest
from support.forks import forked
from support.launch_file import FILE, constants


@pytest.mark.programs
def test_its_arguments_are_options_of_the_program():
    names = constants()
    text = forked.run('thinmap_ros.tools.robot', '--help').stdout
    for option in (*names['OPTIONS'], *names['SWITCHES']):
        assert f'--{option} ' in text or f'--{option}]' in text
        assert option in names['ARGUMENTS']


def test_launch_runs_the_program_with_what_it_is_given():
    launch = pytest.importorskip('launch', reason='needs launch, of a ROS 2 installation')
    pytest.importorskip('launch_ros', reason='needs launch_ros, of a ROS 2 installation')
    names = runpy.run_path(str(FILE))
    context = launch.LaunchContext()
    for name, (default, _) in names['ARGUMENTS'].items():
        context.launch_configurations[name] = default
    context.launch_configurations |= {'preset': 'pioneer', 'explore': 'true'}
    (node,) = names['start'](context)
    words = [''.join(part.text for part in word) for word in node.cmd[1:] if isinstance(word, list)]
    assert {'--preset=pioneer', '--explore', '--seconds=5'} <= set(words)
    assert '--web' not in words
