"""Kernels are cached in a writable folder, and recompiled when their code or constants change."""

import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from thinmap_ros.jit import cache

pytestmark = pytest.mark.programs
CONSTANT = 'GAIN = {gain}\n'
MODULE = """
from thinmap_ros.core.constant import GAIN
from thinmap_ros.jit import kernel

@kernel
def amplified(value):
    return GAIN * value
"""
PAIR = """
from typing import NamedTuple

class Pair(NamedTuple):
    first: float
    second: float
"""
MODULE_OF_PAIRS = """
from thinmap_ros.jit import kernel
from thinmap_ros.core.pair import Pair

@kernel
def product(pair):
    return pair.first * pair.second

def amplified(value):
    return product(Pair(value, 2.0))
"""
MODULE_OF_QUOTIENTS = """
from thinmap_ros.core.pair import Pair
from thinmap_ros.jit import kernel

@kernel
def quotient(pair):
    return pair.first / pair.second

def amplified(value):
    return quotient(Pair(first=value, second=2.0))
"""
PROGRAM = """
from thinmap_ros.kernels import report_compilation
report = report_compilation()
from thinmap_ros.core.amplifier import amplified
from thinmap_ros.jit import cache
print(amplified(3.0), cache.folder())
report.end()
"""
# How many kernels the package has, and how long they usually take.
COUNT = """
from thinmap_ros import jit, kernels
count = jit.declared_kernels()
print(count, 5 * -int(-kernels._USUAL_S * count // 5))
"""


class Install:
    """A copy of the package in a folder, with an additional kernel, and programs that use it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.package = folder / 'thinmap_ros'
        leave_out = shutil.ignore_patterns('__pycache__')
        for name in ('core', 'files', 'jit'):
            shutil.copytree(cache.PACKAGE / name, self.package / name, ignore=leave_out)
        shutil.copy(cache.PACKAGE / 'kernels.py', self.package)
        (self.package / '__init__.py').touch()
        (self.package / 'core' / 'amplifier.py').write_text(MODULE)
        self.set_gain(2.0)

    def set_gain(self, gain: float) -> None:
        """Change a constant in another module than that of the kernel."""
        (self.package / 'core' / 'constant.py').write_text(CONSTANT.format(gain=gain))

    def edit(self, module: str, before: str, after: str) -> None:
        """Replace the first occurrence of a text in a module of the core."""
        path = self.package / 'core' / f'{module}.py'
        text = path.read_text()
        assert before in text
        path.write_text(text.replace(before, after, 1))

    def close_to_writing(self) -> None:
        """Make the folder of the package unwritable, also for root."""
        (self.package / '__pycache__').touch()

    def run(self, **variables: str) -> tuple[list[str], str]:
        """Output of the program: value and folder; and its stderr."""
        done = self._done(PROGRAM, variables)
        return done.stdout.split(), done.stderr

    def output(self, code: str) -> str:
        """Output of another program."""
        return self._done(code, {}).stdout

    def _done(self, code: str, variables: dict[str, str]) -> 'subprocess.CompletedProcess[str]':
        environment = {**os.environ, 'PYTHONPATH': str(self.folder), 'PYTHONDONTWRITEBYTECODE': '1'}
        for name in ('NUMBA_CACHE_DIR', 'XDG_CACHE_HOME', 'HOME'):
            environment.pop(name, None)
        environment |= {'XDG_CACHE_HOME': str(self.folder / 'home'), **variables}
        command = [sys.executable, '-c', code]
        done = subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done


@pytest.fixture
def install(tmp_path: Path) -> Install:
    return Install(tmp_path)


def test_the_first_run_reports_that_it_compiles_and_later_ones_do_not(install: Install) -> None:
    (value, folder), said = install.run()
    assert value == '6.0'
    assert Path(folder).parent == install.folder / 'home' / 'thinmap'
    first, last = said.splitlines()
    declared, usual_s = install.output(COUNT).split()
    assert first == (
        f'thinmap: compiling kernels, once: 0 of at most {declared}, about {usual_s} s left if all '
        'are needed'
    )
    assert last.startswith('thinmap: kernels compiled in ')
    assert last.endswith(f'cached in {folder}')
    assert install.run() == (['6.0', folder], '')


def test_a_kernel_follows_what_it_imports(install: Install) -> None:
    """Numba's own cache only checks the module of the kernel, and would return 6.0 forever."""
    install.run()
    install.set_gain(5.0)
    (value, _), said = install.run()
    assert value == '15.0'
    assert 'compiling' in said


def test_a_kernel_whose_types_have_moved_is_compiled_again(install: Install) -> None:
    """As when a module was renamed since an earlier version."""
    core = install.package / 'core'
    (core / 'pair.py').write_text(PAIR)
    (core / 'amplifier.py').write_text(MODULE_OF_PAIRS)
    assert install.run()[0][0] == '6.0'
    (core / 'pair.py').rename(core / 'couple.py')
    (core / 'amplifier.py').write_text(MODULE_OF_PAIRS.replace('core.pair', 'core.couple'))
    (value, _), said = install.run()
    assert value == '6.0'
    assert 'compiling' in said


@pytest.mark.parametrize(
    ('module', 'before', 'after'),
    [
        ('constant', 'GAIN', '# A comment above what the kernel names.\nGAIN'),
        ('amplifier', '@kernel', '# A comment above the kernel.\n\n@kernel'),
        ('amplifier', 'return', '"""A docstring."""\n    # And a comment.\n    return'),
        ('amplifier', '@kernel', 'class Other:\n    """Beside."""\n\n@kernel'),
        (
            'errors',
            'class InputError',
            'class Other(Exception): ...\n\n\nclass InputError',
        ),
    ],
)
def test_what_a_kernel_is_not_compiled_from_recompiles_nothing(
    install: Install, module: str, before: str, after: str
) -> None:
    install.run()
    install.edit(module, before, after)
    assert install.run()[1] == ''


def test_a_named_tuple_with_other_fields_is_another_type(install: Install) -> None:
    """Compiled code accesses the fields by their position."""
    (install.package / 'core' / 'pair.py').write_text(PAIR)
    (install.package / 'core' / 'amplifier.py').write_text(MODULE_OF_QUOTIENTS)
    assert install.run()[0][0] == '1.5'
    install.edit('pair', 'first: float\n    second: float', 'second: float\n    first: float')
    (value, _), said = install.run()
    assert value == '1.5'
    assert 'compiling' in said


def test_installs_with_equal_code_share_them_and_others_keep_theirs(tmp_path: Path) -> None:
    """As of clones of one repository, or of a clone and a wheel."""
    one, equal, other = (Install(tmp_path / name) for name in ('one', 'equal', 'other'))
    other.set_gain(5.0)
    home = {'XDG_CACHE_HOME': str(tmp_path / 'home')}
    assert 'compiling' in one.run(**home)[1]
    assert equal.run(**home) == one.run(**home)
    assert equal.run(**home)[1] == ''
    (value, _), said = other.run(**home)
    assert (value, 'compiling' in said) == ('15.0', True)
    for install, value in ((one, '6.0'), (equal, '6.0'), (other, '15.0')):
        assert (install.run(**home)[0][0], install.run(**home)[1]) == (value, '')


def test_processes_that_compile_at_the_same_time_leave_whole_kernels(tmp_path: Path) -> None:
    installs = [Install(tmp_path / str(number)) for number in range(4)]
    for install in installs[2:]:
        install.set_gain(5.0)
    home = {'XDG_CACHE_HOME': str(tmp_path / 'home')}
    with ThreadPoolExecutor(len(installs)) as pool:
        first = list(pool.map(lambda install: install.run(**home)[0][0], installs))
    assert first == ['6.0', '6.0', '15.0', '15.0']
    for install, value in zip(installs, first, strict=True):
        ((found, _), said) = install.run(**home)
        assert (found, said) == (value, '')


def test_no_more_than_eight_versions_of_a_kernel_are_kept(tmp_path: Path) -> None:
    for number in range(10):
        for ending in ('nbi', '0.nbc'):
            file = tmp_path / f'module.name.{number}.{ending}'
            file.touch()
            os.utime(file, (number, number))
    (tmp_path / 'module.other.0.nbi').touch()
    cache._forget_old(tmp_path, 'module.name')
    left = {file.name for file in tmp_path.glob('module.name.*.nbi')}
    assert left == {f'module.name.{number}.nbi' for number in range(2, 10)}
    assert len(list(tmp_path.glob('*.nbc'))) == 8
    assert (tmp_path / 'module.other.0.nbi').exists()


def test_without_a_home_they_are_kept_beside_the_package(install: Install) -> None:
    beside = str(install.package / '__pycache__' / 'kernels')
    (value, folder), _ = install.run(XDG_CACHE_HOME='/dev/null/home')
    assert (value, folder) == ('6.0', beside)
    assert install.run(XDG_CACHE_HOME='/dev/null/home') == (['6.0', folder], '')


def test_a_read_only_install_without_a_home_keeps_them_among_temporary_files(
    install: Install,
) -> None:
    install.close_to_writing()
    variables = {'XDG_CACHE_HOME': '/dev/null/home', 'TMPDIR': str(install.folder)}
    (value, folder), _ = install.run(**variables)
    private = install.folder / f'thinmap-{os.getuid()}'
    assert value == '6.0'
    assert private in Path(folder).parents
    assert private.stat().st_mode & 0o777 == 0o700
    assert install.run(**variables) == (['6.0', folder], '')


def test_kernels_are_not_kept_where_others_may_write(install: Install) -> None:
    """Cache files contain code."""
    install.close_to_writing()
    private = install.folder / f'thinmap-{os.getuid()}'
    private.mkdir()
    private.chmod(0o777)
    variables = {'XDG_CACHE_HOME': '/dev/null/home', 'TMPDIR': str(install.folder)}
    (value, folder), said = install.run(**variables)
    assert (value, folder) == ('6.0', 'None')
    assert said.count('UserWarning: kernels are compiled at each start') == 1
    assert 'NUMBA_CACHE_DIR' in said
    assert 'closed to other users' in said
    assert not list(private.iterdir())


def test_the_folder_of_numba_itself_comes_first(install: Install) -> None:
    (value, folder), _ = install.run(NUMBA_CACHE_DIR=str(install.folder / 'chosen'))
    assert (value, folder) == ('6.0', str(install.folder / 'chosen'))
    assert list((install.folder / 'chosen').rglob('*.nbc'))
    assert not (install.package / '__pycache__').exists()


def test_a_folder_of_numba_that_cannot_be_written_to_is_passed_over(install: Install) -> None:
    (value, folder), _ = install.run(NUMBA_CACHE_DIR='/dev/null/chosen')
    assert (value, Path(folder).parent) == ('6.0', install.folder / 'home' / 'thinmap')


def test_what_an_administrator_compiled_is_taken_over(install: Install) -> None:
    """With `warm_up --for-all-users`; the users of the read-only install need not compile."""
    code = 'from thinmap_ros.jit import cache\nprint(cache.leave_beside_package())'
    install.run()
    beside = install.package / '__pycache__' / 'kernels'
    assert install.output(code) == f'{beside}\n'
    (value, folder), said = install.run(XDG_CACHE_HOME=str(install.folder / 'user'))
    assert (value, said) == ('6.0', '')
    names = {file.relative_to(beside) for file in beside.rglob('*.nb[ic]')}
    assert names
    assert {file.relative_to(folder) for file in Path(folder).rglob('*') if file.is_file()} == names
