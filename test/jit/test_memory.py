"""Memory is released where it can be, and nothing else happens where it cannot."""

import gc
import os
import resource
import subprocess
import sys

import pytest

from thinmap_ros import kernels


def test_without_a_file_that_may_be_opened_nothing_is_released_and_nothing_raised():
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    gc.collect()  # else files of earlier tests are closed below
    lowest = os.dup(0)
    os.close(lowest)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, limits[1]))
    try:
        release = kernels.compiler_memory_releaser(period_s=-1.0)
        release()
        kernels.release_compiler_pages()
        assert kernels._shared_bytes() == 0
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert kernels._shared_bytes() > 0


# In a process of its own: others release, too.
_RELEASES = """
import gc
import numba
import numpy as np
from numba.core.codegen import CPUCodeLibrary
from thinmap_ros import kernels
from thinmap_ros.core.topology.thinning import column_distance, true_cells

def kept_modules():
    libraries = [each for each in gc.get_objects() if issubclass(type(each), CPUCodeLibrary)]
    return [library for library in libraries if library._shared_module is not None]

mask = np.ones((3, 3), dtype=bool)
expected = true_cells(mask).sum() + column_distance(mask).sum()
assert kept_modules()
kernels.release_compiler_pages()
assert not kept_modules()

@numba.njit
def both(mask):
    return true_cells(mask).sum() + column_distance(mask).sum()

assert both(mask) == expected
kernels.release_compiler_pages()
assert not kept_modules()
"""


@pytest.mark.programs
def test_modules_of_kernels_are_released_and_others_can_still_be_compiled_from_them():
    subprocess.run([sys.executable, '-c', _RELEASES], check=True)
