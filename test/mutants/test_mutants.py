"""scripts/mutants reports the killed and the surviving mutants of a small package."""

import subprocess
from pathlib import Path

import pytest

from mutants.__main__ import EQUIVALENT, ROOT, chosen, equivalent_changes, main, parsed
from mutants.mutations import mutations

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
def test_a_seed_chooses_the_same_mutants(project) -> None:
    def of(*more: str) -> list[object]:
        return list(chosen(parsed(words(project, *more))))

    assert of('--count', '4') == of('--count', '6')[:4]
    assert of('--seed', '1') != of('--seed', '2')
    assert not of('--skip', 'package/core')


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
