"""Programs that are run in the process of the tests."""

import pytest

from thinmap_ros.kernels import report_compilation


@pytest.fixture(autouse=True)
def nothing_compiled() -> None:
    """What a program prints is its own: the report of compilation is that of the process."""
    report_compilation().end()
