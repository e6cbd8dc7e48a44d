"""The benchmarks of `python -m benchmarks`, of benchmarks.csv, in the order of the page Speed."""

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from benchmarks.rows import Row, read_cases


@dataclass(frozen=True)
class Benchmark:
    """A function that yields rows, by the folder of worlds and whether it is to be quick.

    title, about: of its section on the page Speed, which has none where they are empty.
    """

    name: str
    module: str
    function: str
    title: str = ''
    about: str = ''

    def rows(self, worlds: Path, quick: bool) -> Iterable[Row]:
        """Run it."""
        found: Iterable[Row] = getattr(import_module(self.module), self.function)(worlds, quick)
        return found


_FILE = Path(__file__).with_name('benchmarks.csv')
BENCHMARKS = {each.name: each for each in read_cases(_FILE, Benchmark)}
