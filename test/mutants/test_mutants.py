"""scripts/mutants reports the killed and the surviving mutants of a small package."""

import signal
import subprocess
from pathlib import Path

import pytest
from support.timeouts import PATIENCE_S

from mutants.__main__ import (
    EQUIVALENT,
    ROOT,
    chosen,
    equivalent_changes,
    main,
    parsed,
    report,
    share_killed,
)
from mutants.mutations import mutations
from mutants.runner import Fate, Result, Workshop, fate_of
from mutants.selection import Selection

MODULE = """
LIMIT: int = 4


def bounded(value: int) -> int:
    if value > LIMIT:
        return LIMIT
    return value


def is_odd(value: int) -> bool:
    return value % 2 == 1
"""
TEST = """
from package.core.bounds import bounded


def test_values_above_the_limit():
    assert bounded(9) == 4
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project with a module of two functions, of which one is tested."""
    files = {
        'package/__init__.py': '',
        'package/core/__init__.py': '',
        'package/core/bounds.py': MODULE,
        'test/core/test_bounds.py': TEST,
        'pyproject.toml': '[tool.pytest.ini_options]\nmarkers = ["slow: no", "live: no"]\n',
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    subprocess.run(['git', 'init', '-q', str(tmp_path)], check=True)
    return tmp_path


def words(project: Path, *more: str) -> list[str]:
    equivalent = project / 'equivalent.tsv'
    if not equivalent.exists():
        equivalent.write_text('')
    given = ['--root', str(project), '--folders', 'package/core', '--equivalent', str(equivalent)]
    return [*given, *more]


@pytest.mark.programs
def test_killed_and_surviving_mutants_are_told_apart(project, capsys) -> None:
    assert main(words(project)) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == '6 mutants, and 0 equivalent ones'
    killed = [line for line in lines if ': killed' in line]
    assert len(killed) == 1
    assert 'package/core/bounds.py:2 test/core/test_bounds.py::test_values' in killed[0]
    at = lines.index('survived: package/core/bounds.py:6')
    assert lines[at + 1 : at + 3] == ['    - if value > LIMIT:', '    + if value >= LIMIT:']
    assert lines[-5:-1] == [
        '    1 killed',
        '    0 killed by its CPU limit',
        '    0 timed out',
        '    5 survived',
    ]
    assert lines[-1] == 'seed 39: 16.7% of 6 mutants killed'
    assert not (project / 'out' / 'mutants').exists()
    assert (project / 'package' / 'core' / 'bounds.py').read_text() == MODULE


@pytest.mark.programs
def test_an_equivalent_mutant_is_not_counted(project, capsys) -> None:
    row = ['package/core/bounds.py', 'if value > LIMIT:', 'if value >= LIMIT:', 'both give LIMIT']
    (project / 'equivalent.tsv').write_text('\t'.join(row) + '\n')
    (project / 'test' / 'core' / 'test_bounds.py').write_text(
        TEST.replace('bounded\n', 'bounded, is_odd\n')
        + '    assert bounded(5) == 4\n    assert [is_odd(k) for k in (1, 2, 5)] == [1, 0, 1]\n'
    )
    assert main(words(project)) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == '5 mutants, and 1 equivalent ones'
    assert lines[-1] == 'seed 39: 100.0% of 5 mutants killed'


@pytest.mark.programs
def test_a_test_that_fails_without_a_mutant_ends_it(project) -> None:
    (project / 'test' / 'core' / 'test_bounds.py').write_text(TEST + '    assert bounded(1) == 2\n')
    with pytest.raises(SystemExit, match=r'fail without a mutant: test/core/test_bounds\.py::test'):
        main(words(project, '--last', '1'))


@pytest.mark.programs
def test_a_mutant_that_loops_is_killed_by_a_limit_from_the_time_of_the_tests(project) -> None:
    source = 'def counted(value):\n    while value > 0:\n        value -= 1\n    return value'
    test = 'from package.core.loop import counted\n\n\ndef test_it():\n    assert counted(3) == 0\n'
    added(project, 'package/core/loop.py', source + '\n')
    added(project, 'test/core/test_loop.py', test)
    (project / 'out').mkdir()
    workshop = Workshop(project, 'package', project / 'out')
    loop = Path('package/core/loop.py')
    found = {m.before_and_after(source.encode())[1]: m for m in mutations(loop, source.encode())}
    result = workshop.run(found['value += 1'], limit_s=PATIENCE_S)
    assert (result.fate, result.test) == (Fate.KILLED_BY_LIMIT, '')
    assert workshop.run(found['value -= 2'], limit_s=PATIENCE_S).fate is Fate.KILLED


@pytest.mark.parametrize(
    ('code', 'has_failed', 'fate', 'is_killed'),
    [
        (1, True, Fate.KILLED, True),
        (-signal.SIGSEGV, False, Fate.KILLED, True),
        (-signal.SIGXCPU, False, Fate.KILLED_BY_LIMIT, True),
        (None, False, Fate.TIMED_OUT, False),
        (0, False, Fate.SURVIVED, False),
    ],
)
def test_fate_of_a_mutant(code, has_failed, fate, is_killed) -> None:
    assert fate_of(code, has_failed) is fate
    assert fate.is_killed == is_killed


def test_mutants_that_time_out_have_lines_of_their_own_and_do_not_count_as_killed(tmp_path) -> None:
    (tmp_path / 'a.py').write_text('a = 1\n')
    (mutation,) = mutations(Path('a.py'), b'a = 1\n')
    results = [Result(mutation, fate) for fate in (*Fate, Fate.KILLED)]
    assert list(report(tmp_path, results)) == [
        'timed out: a.py:1\n    - a = 1\n    + a = 2',
        'survived: a.py:1\n    - a = 1\n    + a = 2',
        '    2 killed',
        '    1 killed by its CPU limit',
        '    1 timed out',
        '    1 survived',
    ]
    assert share_killed(results) == pytest.approx(3 / 5)


@pytest.mark.programs
def test_a_seed_chooses_the_same_mutants(project) -> None:
    def of(*more: str) -> list[object]:
        return list(chosen(parsed(words(project, *more))))

    assert of('--count', '4') == of('--count', '6')[:4]
    assert of('--seed', '1') != of('--seed', '2')
    assert not of('--skip', 'package/core')


def added(project: Path, name: str, text: str) -> Path:
    (project / name).parent.mkdir(exist_ok=True)
    (project / name).write_text(text)
    return Path(name)


@pytest.mark.programs
def test_of_equally_near_tests_those_that_import_less_come_first(project) -> None:
    added(project, 'package/core/other.py', '')
    more = added(project, 'test/core/test_a.py', 'from package.core import bounds, other\n')
    less = added(project, 'test/core/test_b.py', 'from package.core import bounds\n')
    mirrored = Path('test/core/test_bounds.py')
    found = Selection(project, 'package').tests_of(project / 'package/core/bounds.py')
    assert found == [mirrored, less, more]


@pytest.mark.programs
def test_the_test_of_the_documented_parameters_belongs_to_modules_with_parameters(project) -> None:
    reference = added(project, 'test/docs/test_node_reference.py', '')
    module = project / 'package/core/bounds.py'
    assert reference not in Selection(project, 'package').tests_of(module)
    module.write_text(MODULE + 'share: float = parameter(0.5)\n')
    assert Selection(project, 'package').tests_of(module)[-1] == reference


@pytest.mark.parametrize(
    ('source', 'expected'),
    [
        ('a = b + 1', ['a = b - 1', 'a = b + 2']),
        ('a = (b) < (c)', ['a = (b) <= (c)']),
        ('a = b and c and d', ['a = b or c and d', 'a = b and c or d']),
        ('a = not b', ['a = b']),
        ('a = -b', ['a = b']),
        ('a += 0.5', ['a -= 0.5', 'a += 1.0']),
        ('a = True', ['a = False']),
        ('a.append(b)', ['pass']),
        ('a = min(b, c)', ['a = max(b, c)']),
        ('a = np.argmin(b)', ['a = np.argmax(b)']),
        ('for a in b: break', ['for a in b: continue']),
        ('a: tuple[1] = b', []),
        ("raise E(f'{a + 1}')", []),
        ('"Text."', []),
        ('for a, b in zip(c, d, strict=True): e(a)', ['for a, b in zip(c, d, strict=True): pass']),
        ('T = TypeVar("T", bound=a + 1)', []),
    ],
)
def test_mutations_of_a_statement(source: str, expected: list[str]) -> None:
    found = mutations(Path('a.py'), source.encode())
    after = [mutation.before_and_after(source.encode())[1] for mutation in found]
    assert sorted(after) == sorted(expected)


def test_every_equivalent_mutant_is_one_of_today_and_has_a_reason() -> None:
    for (path, before, after), reason in equivalent_changes(EQUIVALENT).items():
        source = (ROOT / path).read_bytes()
        found = [mutation.before_and_after(source) for mutation in mutations(Path(path), source)]
        assert (before, after) in found, f'{path}: {before}'
        assert len(reason) > 20
