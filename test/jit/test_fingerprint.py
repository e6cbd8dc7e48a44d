"""The fingerprint of a kernel: what it is compiled from, and nothing else."""

import itertools
import shutil
import subprocess
import sys
from enum import IntEnum
from pathlib import Path

import pytest

from thinmap_ros import jit
from thinmap_ros.jit.cache import OPTIONS, PACKAGE, fingerprint

# Of all kernels of the core and of the simulator, by module and name.
FINGERPRINTS = """
import pkgutil
from importlib import import_module
import thinmap_ros
from thinmap_ros import jit
from thinmap_ros.jit.cache import fingerprint
for room in ('baselines', 'core', 'sim'):
    package = import_module(f'thinmap_ros.{room}')
    for module in pkgutil.walk_packages(package.__path__, f'thinmap_ros.{room}.'):
        import_module(module.name)
for kernel in jit.KERNELS:
    function = kernel.py_func
    print(f'{function.__module__}.{function.__name__}', fingerprint(function))
"""
MODULE = """
import numpy as np
from thinmap_ros.jit import inlined, kernel

LIMIT = {limit}
STEPS = np.array({steps})
CELL = np.dtype([('{field}', np.uint8)])

@kernel
def walk(value):
    return step(value) + np.zeros(1, CELL).size + {addend}

@{decorator}
def step(value):
    return min(value + STEPS[0], LIMIT)
"""
AS_IT_IS = {'limit': 2.0, 'steps': [1, 2], 'addend': 1, 'field': 'hits', 'decorator': 'inlined'}


def fingerprints(folder: Path) -> dict[str, str]:
    done = subprocess.run(
        [sys.executable, '-c', FINGERPRINTS],
        cwd=folder,
        env={'PYTHONPATH': str(folder), 'NUMBA_CACHE_DIR': str(folder / 'cache')},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return dict(line.split() for line in done.stdout.splitlines())


@pytest.fixture
def copied_package(tmp_path: Path) -> Path:
    ignored = shutil.ignore_patterns('__pycache__')
    return Path(shutil.copytree(PACKAGE, tmp_path / PACKAGE.name, ignore=ignored))


def with_another_text(text: str) -> str:
    """A module with a comment above each line at its margin, and with other docstrings."""
    lines = text.replace('"""', '"""In other words: ', 1).splitlines()
    margins = (line.startswith(('def ', 'class ', '@')) for line in lines)
    pairs = zip(lines, margins, strict=True)
    commented = (['# A comment.', line] if is_margin else [line] for line, is_margin in pairs)
    return '\n'.join(itertools.chain.from_iterable(commented)) + '\n'


@pytest.mark.programs
def test_comments_docstrings_defaults_and_errors_change_no_kernel(copied_package: Path) -> None:
    before = fingerprints(copied_package.parent)
    for path in copied_package.rglob('*.py'):
        path.write_text(with_another_text(path.read_text()))
    errors = copied_package / 'core' / 'errors.py'
    errors.write_text(f'{errors.read_text()}\n\nclass OtherError(ThinmapError):\n    pass\n')
    topology = copied_package / 'core' / 'topology' / 'graph.py'
    default = 'min_branch_length_m: float = parameter(\n        '
    assert default in topology.read_text()
    topology.write_text(topology.read_text().replace(default, f'{default}0.5 + '))
    assert len(before) > 140
    assert fingerprints(copied_package.parent) == before


@pytest.mark.programs
def test_a_changed_kernel_changes_those_that_call_it(copied_package: Path) -> None:
    before = fingerprints(copied_package.parent)
    rays = copied_package / 'core' / 'grid' / 'raytrace.py'
    rays.write_text(rays.read_text().replace('for _ in range(steps + 1)', 'for _ in range(steps)'))
    after = fingerprints(copied_package.parent)
    changed_kernels = {name for name, word in after.items() if word != before[name]}
    assert 'thinmap_ros.core.grid.raytrace.line_is_clear' in changed_kernels
    assert 'thinmap_ros.core.exploration.space._hidden_cells' not in changed_kernels
    assert 1 < len(changed_kernels) < 30


def fingerprint_of(**changes: object) -> str:
    values = AS_IT_IS | changes
    names: dict[str, object] = {'__name__': 'thinmap_ros_test'}
    code = compile(MODULE.format(**values), __file__, 'exec')
    exec(code, names)
    return fingerprint(names['walk'].py_func)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    'change',
    [
        {'limit': 3.0},
        {'limit': 2},
        {'steps': [1, 3]},
        {'steps': [1.0, 2.0]},
        {'addend': 2},
        {'field': 'seen'},
        {'decorator': 'kernel'},
    ],
    ids=str,
)
def test_code_and_the_values_that_it_names_count(change: dict[str, object]) -> None:
    assert fingerprint_of() == fingerprint_of()
    assert fingerprint_of(**change) != fingerprint_of()


def test_how_all_kernels_are_compiled_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    before = fingerprint_of()
    monkeypatch.setitem(OPTIONS, 'fastmath', True)
    assert fingerprint_of() != before


def test_members_of_an_enumeration_count() -> None:
    def state_of(members: list[str]) -> str:
        State = IntEnum('State', members)

        @jit.kernel
        def is_first(value: int) -> bool:
            return value == State.free

        return fingerprint(is_first.py_func)  # type: ignore[attr-defined]

    assert state_of(['free', 'wall']) == state_of(['free', 'wall'])
    assert state_of(['free', 'wall']) != state_of(['wall', 'free'])


def test_a_recursive_kernel_has_one() -> None:
    @jit.kernel
    def factorial(value: int) -> int:
        return 1 if value < 2 else value * factorial(value - 1)

    assert fingerprint(factorial.py_func)  # type: ignore[attr-defined]
