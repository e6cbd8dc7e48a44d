"""Kernels are compiled without bounds checks, or with them on request."""

import os
import subprocess
import sys

import pytest

MODULE = """
import numpy as np
from thinmap_ros.jit import kernel

@kernel
def beyond(values, index):
    values[index] = 1.0

beyond(np.zeros(4), 3)
memory = np.zeros(8)
beyond(memory[:4], 4)
"""


@pytest.mark.programs
@pytest.mark.parametrize('checked', [False, True])
def test_bounds_are_checked_where_that_is_asked_for(tmp_path, checked):
    """scripts/test runs all tests of core once like this: such a run finds errors."""
    (tmp_path / 'outside.py').write_text(MODULE)
    environment = {**os.environ, 'NUMBA_BOUNDSCHECK': str(int(checked))}
    environment['NUMBA_CACHE_DIR'] = str(tmp_path / 'cache')
    command = [sys.executable, str(tmp_path / 'outside.py')]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ('IndexError' in done.stderr) == checked, done.stderr
    assert (done.returncode != 0) == checked
