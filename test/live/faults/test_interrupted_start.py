"""Ctrl-C while a program imports its modules: one line, exit code 130."""

import signal
import subprocess
import sys

import pytest

pytestmark = pytest.mark.live
PROGRAMS = {
    'demo': ('thinmap_ros.tools.demo',),
    'thinmap': ('thinmap_ros', 'demo'),
    'navigator': ('thinmap_ros.nodes.navigator',),
}


@pytest.mark.parametrize('module', ['thinmap_ros.startup', 'numpy', 'numba.core.types'])
@pytest.mark.parametrize('name', PROGRAMS)
@pytest.mark.usefixtures('ros_domain')
def test_an_interrupted_start_ends_with_one_line(tmp_path, name, module):
    program = PROGRAMS[name]
    # Python reports each module that it has imported.
    command = [sys.executable, '-X', 'importtime', '-m', *program]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    for line in process.stderr:
        if line.startswith('import time:') and line.rpartition('|')[2].strip() == module:
            process.send_signal(signal.SIGINT)
            break
    rest = process.stderr.read().splitlines()
    assert process.wait() == 130
    assert [line for line in rest if 'import time:' not in line] == [f'{name}: interrupted']


def test_a_library_that_is_imported_leaves_the_handler_as_it_is():
    program = 'import signal, thinmap_ros, thinmap_ros.nodes.localizer\n'
    program += 'print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)'
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True)
    assert done.stdout == 'True\n'
