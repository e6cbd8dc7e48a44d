"""Constants that the benchmark changes: wherever they are read, and back again."""

import sys

import numpy as np
import pytest

from benchmarks import place_belief


@pytest.mark.parametrize('name', place_belief.CONSTANTS)
def test_a_constant_is_changed_in_each_module_that_reads_it_and_set_back(name):
    slam = [
        module for key, module in sys.modules.items() if key.startswith('thinmap_ros.core.slam')
    ]
    first = place_belief.CONSTANTS[name][0]
    before = getattr(first, name)
    readers = [module for module in slam if getattr(module, name, None) is before]
    with place_belief.changed(name, 2.0):
        for module in readers:
            np.testing.assert_array_equal(getattr(module, name), 2.0 * before)
    assert all(getattr(module, name) is before for module in readers)
