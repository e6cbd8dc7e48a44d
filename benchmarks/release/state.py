"""What a release has finished: a file with commit, machine and steps."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from thinmap_ros.core.errors import InputError
from thinmap_ros.files.safe import read_text, write_text

_FILE = 'state.json'


@dataclass(frozen=True)
class Finished:
    """A finished step: its command, how long it took, s, and when it ended (UTC, ISO 8601)."""

    command: list[str]
    seconds: float
    ended: str


@dataclass(frozen=True, eq=False)
class State:
    """Finished steps of a commit on a machine, by name."""

    commit: str
    machine: str
    steps: dict[str, Finished] = field(default_factory=dict)


def read_state(folder: Path, commit: str, machine: str) -> State:
    """State of a folder; a new one if the folder has none.

    Raises InputError if it is damaged, or of another commit or machine: its results would be mixed
    with those of this one.
    """
    path = folder / _FILE
    if not path.exists():
        return State(commit, machine)
    try:
        words = json.loads(read_text(path))
        steps = {name: Finished(**step) for name, step in words['steps'].items()}
        known = State(words['commit'], words['machine'], steps)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f'{path}: damaged: expected the state of a release') from error
    for what, there, here in (
        ('commit', known.commit, commit),
        ('machine', known.machine, machine),
    ):
        if there != here:
            raise InputError(f'{path}: {what} {there}: expected {here}, or another folder by --out')
    return known


def write_state(folder: Path, state: State) -> None:
    """Write the state to its folder."""
    write_text(folder / _FILE, json.dumps(asdict(state), indent=2) + '\n')
