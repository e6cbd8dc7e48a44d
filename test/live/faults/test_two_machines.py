"""Two machines: two network namespaces with a virtual Ethernet between them."""

import json
import time

import pytest
from support.halls import AT_START, START
from support.machines import Cable, Machines, Weakness

from thinmap_ros.core.errors import InputError
from thinmap_ros.logs.readers.bag import Bag

pytestmark = pytest.mark.live
WEAK = Weakness(loss=0.05, delay_s=0.05, seed=7)


@pytest.fixture(params=['cable'])
def machines(request, ros_domain, tmp_path):
    weakness = WEAK if request.param == 'weak link' else None
    both = Machines(tmp_path, [Cable((0, 1), weakness)])
    yield both
    both.close()


def recorded(bag, topic):
    try:
        return sum(1 for _ in Bag(bag).messages({topic}))
    except InputError:
        return 0


def start_mapping(machines, machine):
    for name in ('localizer', 'grid_mapper', 'topology_builder'):
        machines.start(
            machine, name, use_sim_time=True, **(AT_START if name == 'localizer' else {})
        )


@pytest.mark.cpu_budget(20.0, 'nodes on machines of their own start as those of a user')
def test_a_robot_here_and_its_map_there_outlive_a_cable_that_is_pulled(machines, tmp_path):
    bag = tmp_path / 'bag'
    machines.start(0, 'recorder', bag=str(bag), use_sim_time=True)
    start_mapping(machines, 1)
    machines.start(
        0,
        'sim',
        start=START,
        real_time_factor=4.0,
        lockstep='local_topology',
        wait_for_subscribers=2,
    )
    machines.wait(lambda: recorded(bag, '/local_topology') > 10, 'the graph comes over')
    machines.unplugged(3.0)
    before = recorded(bag, '/local_topology')
    machines.wait(lambda: recorded(bag, '/local_topology') > before + 15, 'it continues')
    # Scans went in one direction, maps and graphs in the other.
    assert machines.received_bytes(1) > 50_000 and machines.received_bytes(0) > 50_000
    assert all(process.poll() is None for process in machines.processes.values()), machines.logs()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_an_exploration_over_the_cable_finishes_though_it_is_pulled_for_five_seconds(
    machines, tmp_path
):
    result = tmp_path / 'result.json'
    start_mapping(machines, 1)
    for name in ('navigator', 'explorer'):
        machines.start(0, name, use_sim_time=True)
    machines.start(
        0,
        'sim',
        start=START,
        real_time_factor=5.0,
        lockstep='local_topology',
        wait_for_subscribers=3,
    )
    monitor = machines.start(0, 'demo_monitor', use_sim_time=True, result=str(result))
    time.sleep(30.0)
    machines.unplugged(5.0)
    machines.wait(lambda: monitor.poll() is not None, 'the exploration ends', 800.0)
    assert json.loads(result.read_text())['finished'], machines.logs()


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize('machines', ['weak link'], indirect=True)
def test_an_exploration_in_real_time_over_a_weak_link_finishes_though_it_breaks_as_well(
    machines, tmp_path
):
    result = tmp_path / 'result.json'
    start_mapping(machines, 1)
    for name in ('navigator', 'explorer'):
        machines.start(0, name, use_sim_time=True)
    # Without lockstep: late messages stay late.
    machines.start(0, 'sim', start=START, wait_for_subscribers=3)
    monitor = machines.start(0, 'demo_monitor', use_sim_time=True, result=str(result))
    time.sleep(30.0)
    machines.unplugged(5.0)
    machines.wait(lambda: monitor.poll() is not None, 'the exploration ends', 800.0)
    assert json.loads(result.read_text())['finished'], machines.logs()
    frames = machines.frames()
    assert 0.04 < frames['lost'] / (frames['carried'] + frames['lost']) < 0.06, frames
