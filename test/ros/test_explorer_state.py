"""The state of the explorer in messages, and in the checkpoint that it restores or refuses."""

import numpy as np
import pytest

from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.exploration.mission import MissionState
from thinmap_ros.core.exploration.strategy import FinishCode
from thinmap_ros.nodes.parts.mission import ExplorerState

GOAL_ID = bytes(range(16))
PREFIX = bytes(range(8))


def state(goal_id=GOAL_ID):
    return ExplorerState(7, goal_id, PREFIX, {'phase': np.array(1)}, {'phase': np.array(2)})


@pytest.mark.parametrize('goal_id', [GOAL_ID, b''])
def test_a_state_is_restored_from_its_arrays(goal_id):
    again = ExplorerState.from_arrays(state(goal_id).arrays())
    assert (again.latest_ns, again.goal_id, again.drive_prefix) == (7, goal_id, PREFIX)
    assert again.mission == {'phase': np.array(1)}
    assert again.strategy == {'phase': np.array(2)}


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('latest_ns', np.array(-1)),
        ('goal_ids', np.zeros((1, 15), dtype=np.uint8)),
        ('goal_ids', np.zeros((1, 16))),
        ('drive_prefix', np.zeros(9, dtype=np.uint8)),
    ],
)
def test_what_is_no_state_is_refused(name, value):
    with pytest.raises(InputError, match=name):
        ExplorerState.from_arrays({**state().arrays(), name: value})


@pytest.mark.parametrize('name', ['latest_ns', 'goal_ids', 'drive_prefix'])
def test_nothing_may_be_missing(name):
    arrays = dict(state().arrays())
    del arrays[name]
    with pytest.raises(InputError, match=name):
        ExplorerState.from_arrays(arrays)


def test_codes_and_states_are_those_of_the_message():
    for code in FinishCode:
        assert getattr(ExplorationStatus, code.name) == code
    for state in MissionState:
        assert getattr(ExplorationStatus, state.name) == state
