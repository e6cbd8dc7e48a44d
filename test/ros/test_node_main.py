"""How the process of a node runs."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.live
PROGRAM = """
import gc
from rclpy.node import Node
from thinmap_ros.ros import node_main


class Short(Node):
    def __init__(self):
        super().__init__('short')
        self.objects = len(gc.get_objects())

    @property
    def finished(self):
        print(len(gc.get_objects()) < 0.1 * self.objects)
        return True


node_main.run(Short)
"""


@pytest.mark.usefixtures('ros_domain')
def test_the_collector_need_not_look_at_what_the_start_has_made():
    command = [sys.executable, '-c', PROGRAM]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, 'True\n'), done.stderr


EXECUTORS = """
import gc
from rclpy.executors import Executor
from rclpy.node import Node
from thinmap_ros.ros import node_main


class Short(Node):
    def __init__(self, name):
        super().__init__(name)
        self.finished = False
        self.create_timer(0.01, self.end_soon)

    def end_soon(self):
        self.finished = True


gc.disable()
node_main.run_all([lambda: Short('one'), lambda: Short('other')])
gc.unfreeze()
left = [each for each in gc.get_objects() if isinstance(each, Executor)]
print([each._sigint_gc for each in left if each._sigint_gc is not None])
"""


@pytest.mark.usefixtures('ros_domain')
def test_executors_are_ended_before_the_collector_ends_their_parts():
    """It may do so in an order in which the executor writes a traceback."""
    command = [sys.executable, '-c', EXECUTORS]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, '[]\n', '')


CLOSING = """
from rclpy.node import Node
from thinmap_ros.ros import node_main


class Closing(Node):
    finished = True

    def close(self):
        print(self.get_name() + chr(10), end='', flush=True)  # in one piece
        if self.get_name() == 'first':
            raise ValueError('planted')


node_main.run_all([lambda: Closing('first'), lambda: Closing('second')])
"""


@pytest.mark.usefixtures('ros_domain')
def test_each_node_is_closed_once_whatever_becomes_of_the_others():
    done = subprocess.run([sys.executable, '-c', CLOSING], capture_output=True, text=True)
    assert sorted(done.stdout.split()) == ['first', 'second']
    assert done.returncode == 1
    assert 'ValueError: planted' in done.stderr


@pytest.mark.usefixtures('ros_domain')
def test_a_warning_is_one_line_of_the_node(tmp_path):
    (tmp_path / 'hall.pgm').write_bytes(b'P5\n8 8\n255\n' + bytes([205] * 24 + [254] * 40))
    world = tmp_path / 'hall.yaml'
    world.write_text('image: hall.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nfree_thresh: 0.25\n')
    command = [sys.executable, '-m', 'thinmap_ros.nodes.sim', '--ros-args', '-p', f'world:={world}']
    said = subprocess.run(command, capture_output=True, text=True).stderr.splitlines()
    assert [line.partition(str(world))[0] for line in said[:-1]] == ['sim: warning: ']
    assert said[-1].startswith('error: start: world hall has none')
