"""What the first start says: how many kernels there are, and how long they take."""

import re
import subprocess
import sys

import pytest

from thinmap_ros import jit
from thinmap_ros.jit import cache
from thinmap_ros.kernels import progress_text

IMPORT_ALL = """
from importlib import import_module
from pathlib import Path
from thinmap_ros import jit
for file in sorted(jit.cache.PACKAGE.rglob('*.py')):
    if '\\n@kernel\\n' in file.read_text():
        import_module('.'.join(file.relative_to(jit.cache.PACKAGE.parent).with_suffix('').parts))
print(len(jit.KERNELS), jit.declared_kernels())
"""


@pytest.mark.programs
def test_the_number_of_kernels_is_that_of_all_modules() -> None:
    command = [sys.executable, '-c', IMPORT_ALL]
    done = subprocess.run(
        command, cwd=cache.PACKAGE.parent, capture_output=True, text=True, check=True
    )
    imported, declared = done.stdout.split()
    assert imported == declared
    assert int(declared) > 150


def numbers_of(text: str) -> list[int]:
    return [int(number) for number in re.findall(r'\d+', text)]


def test_it_counts_down_to_nothing() -> None:
    most = max(jit.declared_kernels(), len(jit.KERNELS))  # tests have kernels of their own
    lines = [numbers_of(progress_text(k, k, 0.63 * k)) for k in range(most + 1)]
    assert [line[0] for line in lines] == list(range(most + 1))
    assert {line[1] for line in lines} == {most}
    left_s = [line[2] for line in lines]
    assert left_s == sorted(left_s, reverse=True)
    assert left_s[0] == pytest.approx(0.63 * most, abs=5.0)
    assert left_s[-1] == 0


def test_the_time_is_that_of_this_machine_once_it_is_known() -> None:
    most = max(jit.declared_kernels(), len(jit.KERNELS))  # tests have kernels of their own
    slow = numbers_of(progress_text(100, 100, 500.0))[2]
    assert slow == pytest.approx(5.0 * (most - 100), rel=0.2)
    from_cache = numbers_of(progress_text(100, 0, 0.0))[2]
    assert from_cache == pytest.approx(0.63 * (most - 100), abs=5.0)
