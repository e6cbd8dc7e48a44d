"""Tests of a module: that of its name first, then those that import it."""

import itertools
from collections import defaultdict
from pathlib import Path

from support.imports import imported

# Tests that start programs take too long, and check other things.
_LEFT_OUT = {'live', 'docs', 'fuzz', 'tools', 'ros', 'benchmarks', 'experiments', 'mutants'}
# Largest number of test files for a mutant; the nearest come first.
MAX_FILES = 6
# Compares defaults and ranges of parameters with those of the documentation.
_PARAMETERS = Path('test/docs/test_node_reference.py')


class Selection:
    """Imports of a package and of its tests, read from the source."""

    def __init__(self, root: Path, package: str) -> None:
        self._root = root
        self._tests = root / 'test'
        self._importers: dict[Path, set[Path]] = defaultdict(set)
        self._n_imported: dict[Path, int] = {}
        sources = [*(root / package).rglob('*.py'), *self._tests.rglob('*.py')]
        for source in sources:
            found = set(imported(root, source))
            self._n_imported[source.relative_to(root)] = len(found)
            for module in found:
                self._importers[module].add(source)

    def tests_of(self, module: Path) -> list[Path]:
        """Test files of a module, relative to the root, the nearest first.

        Of two equally near ones, that which imports less: it is about this module, and quicker.
        """
        inside = module.relative_to(self._root)
        mirrored = Path('test', *inside.parts[1:-1], f'test_{inside.name}')
        distances = self._distances(module)
        if (self._root / mirrored).exists():
            distances[mirrored] = 0

        def key(test: Path) -> tuple[bool, int, int, Path]:
            is_near = distances[test] <= 1 or test.parent == mirrored.parent
            return not is_near, distances[test], self._n_imported[test], test

        nearest = sorted(distances, key=key)[:MAX_FILES]
        has_parameters = b'= parameter(' in module.read_bytes()
        if has_parameters and (self._root / _PARAMETERS).exists():
            nearest.append(_PARAMETERS)
        return nearest

    def _distances(self, module: Path) -> dict[Path, int]:
        """Tests that import a module, 1; that import what imports it, 2; and so on."""
        distances: dict[Path, int] = {}
        known = {module}
        border = {module}
        for distance in itertools.count(1):
            border = {importer for file in border for importer in self._importers[file]} - known
            if not border:
                break
            known |= border
            for file in border:
                if self._is_test(file):
                    distances[file.relative_to(self._root)] = distance
        return distances

    def _is_test(self, file: Path) -> bool:
        if not file.is_relative_to(self._tests) or not file.name.startswith('test_'):
            return False
        return not _LEFT_OUT & set(file.relative_to(self._tests).parts)
