"""Memory is released where it can be, and nothing else happens where it cannot."""

import gc
import os
import resource

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
