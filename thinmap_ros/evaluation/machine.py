"""What the benchmarks ran on."""

import os
import platform
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

from thinmap_ros.evaluation.table import Row


def machine() -> Iterator[Row]:
    """Processor, cores, and versions."""
    lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    yield Row('processor', names[0] if names else platform.processor())
    yield Row('cores', str(os.cpu_count()))
    yield Row('processes that wanted one of them (load)', f'{os.getloadavg()[2]:.0f}')
    yield Row('Python', platform.python_version())
    for package in ('numpy', 'scipy', 'numba'):
        yield Row(package, version(package))
