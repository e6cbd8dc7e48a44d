"""`support.bounds_key`: when the stage of bounds checks has to run again."""

import pytest
from support.bounds_key import bounds_key

FILES = {
    'test/conftest.py': 'from support.given import GIVEN\n',
    'test/support/given.py': 'GIVEN = 1\n',
    'test/support/other.py': '',
    'test/core/test_kernel.py': 'from thinmap_ros.core.kernel import doubled\n',
    'thinmap_ros/__init__.py': '',
    'thinmap_ros/core/__init__.py': '',
    'thinmap_ros/core/kernel.py': 'import thinmap_ros.jit\n',
    'thinmap_ros/jit/__init__.py': '',
    'thinmap_ros/nodes/sim.py': '',
    'requirements/lock-3.11.txt': 'numpy==2\n',
    'docs/index.md': '',
    'pyproject.toml': '',
}


@pytest.fixture
def project(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ('name', 'is_other'),
    [
        ('thinmap_ros/core/kernel.py', True),
        ('thinmap_ros/core/__init__.py', True),
        ('thinmap_ros/jit/__init__.py', True),
        ('test/core/test_kernel.py', True),
        ('test/support/given.py', True),
        ('requirements/lock-3.11.txt', True),
        ('pyproject.toml', True),
        ('test/support/other.py', False),
        ('thinmap_ros/nodes/sim.py', False),
        ('docs/index.md', False),
    ],
)
def test_the_key_is_that_of_what_the_tests_of_the_core_need(project, name, is_other):
    before = bounds_key(project)
    assert bounds_key(project) == before
    file = project / name
    file.write_text(f'{file.read_text()}# More.\n')
    assert (bounds_key(project) != before) == is_other


def test_the_key_of_another_clone_is_the_same(project, tmp_path_factory):
    clone = tmp_path_factory.mktemp('clone') / 'thinmap'
    project.rename(clone)
    before = bounds_key(clone)
    assert bounds_key(clone.rename(project)) == before
