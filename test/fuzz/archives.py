"""Damaged bags, saved sessions and checkpoints."""

import io
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.cases import Source, chosen, damaged_bytes, tried
from fuzz.damaged_bags import check as check_bag
from fuzz.damaged_bags import damaged, drive, ended, read_log, whole_bags
from fuzz.saved_states import KINDS, Explored, State, one_number_replaced, replaced
from fuzz.saved_states import check as check_state
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.files import sessions
from thinmap_ros.files.safe import VERSION
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.logs.readers.bag import Bag
from thinmap_ros.ros.checkpoint import Checkpoint

_PARTS = {part.name: part for part in sessions.PARTS}


def read_damaged_bag(shared: dict[str, bytes], rng: np.random.Generator, folder: Path) -> None:
    path = folder / 'damaged.mcap'
    path.write_bytes(damaged(shared[chosen(rng, sorted(shared))], rng))
    check_bag(path, folder / 'repaired.mcap')


def drive_messages(folder: Path) -> list[Any]:
    return list(Bag(drive(folder / 'drive.mcap', 12)).messages())


def read_strange_bodies(shared: list[Any], rng: np.random.Generator, folder: Path) -> None:
    """An undamaged bag with some invalid messages."""
    with BagWriter(folder / 'bag.mcap') as writer:
        for message in shared:
            data = bytes(message.data)
            if rng.random() < 0.3:
                data = damaged_bytes(rng, data)
            kind = message.type_name
            if rng.random() < 0.02:
                kind = chosen(rng, shared).type_name
            writer.write(message.topic, kind, message.log_ns, data)
    code, said, complained = ended(read_log, str(folder / 'bag.mcap'))
    assert code in (0, 2), complained
    assert complained.count('\n') <= 1 and len(complained) < 1500, complained
    assert len(said) < 1500, said


def explored(folder: Path) -> Explored:
    return Explored()


def _changed(rng: np.random.Generator, whole: State) -> tuple[str, State]:
    """A state with up to two numbers and up to two arrays replaced."""
    state = whole
    told = []
    for _ in range(int(rng.integers(0, 3))):
        what, state = one_number_replaced(state, rng)
        told.append(what)
    for _ in range(int(rng.integers(0, 3))):
        name = str(chosen(rng, sorted(whole)))
        how, array = chosen(rng, list(replaced(whole[name])))
        state = state | {name: array}
        told.append(f'{name}: {how}')
    return ', '.join(told), state


def use_changed_state(shared: Explored, rng: np.random.Generator, folder: Path) -> None:
    kind = str(chosen(rng, KINDS))
    what, state = _changed(rng, shared.states[kind])
    (folder / 'state.txt').write_text(f'{kind}: {what}\n')
    np.savez(folder / f'{kind}.npz', **{k: v for k, v in state.items() if v.dtype != object})
    check_state(shared, kind, state, what)


def _packed(rng: np.random.Generator, members: dict[str, bytes]) -> bytes:
    """An archive with one damaged member; the archive itself is valid."""
    name = chosen(rng, sorted(members))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, 'w', zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for each, content in members.items():
            damage = each == name and rng.random() < 0.9
            archive.writestr(each, damaged_bytes(rng, content) if damage else content)
    return stream.getvalue()


def _members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def explored_archives(folder: Path) -> tuple[Explored, dict[str, dict[str, bytes]]]:
    found = Explored()
    for kind, state in found.states.items():
        named: dict[str, Any] = {
            'thinmap_format': np.array(f'{kind} {VERSION}'),
            **state,
        }
        np.savez_compressed(folder / f'a{_PARTS[kind].ending}', **named)
    return found, {kind: _members(folder / f'a{_PARTS[kind].ending}') for kind in KINDS}


def load_damaged_archive(
    shared: tuple[Explored, dict[str, dict[str, bytes]]], rng: np.random.Generator, folder: Path
) -> None:
    kind = str(chosen(rng, KINDS))
    content = _packed(rng, shared[1][kind])
    if rng.random() < 0.3:
        content = damaged_bytes(rng, content)
    (folder / f'a{_PARTS[kind].ending}').write_bytes(content)
    loaded = tried(lambda: _PARTS[kind].load(str(folder / 'a')))
    if loaded is not None:
        check_state(shared[0], kind, loaded.state(), 'as it was loaded')


class _Node:
    """The name and the logger of a node."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def get_fully_qualified_name(self) -> str:
        return '/robot/localizer'

    def get_logger(self) -> '_Node':
        return self

    def warning(self, text: str, **_: Any) -> None:
        self.said.append(text)


def go_on_from_what_was_left(shared: State, rng: np.random.Generator, folder: Path) -> None:
    os.environ['THINMAP_STATE_DIR'] = str(folder / 'state')
    node = _Node()
    checkpoint = Checkpoint(node, 1e9)
    checkpoint.save(shared)
    (file,) = (folder / 'state').iterdir()
    content = _packed(rng, _members(file)) if rng.random() < 0.7 else file.read_bytes()
    file.write_bytes(damaged_bytes(rng, content))
    left = checkpoint.load()
    assert all(text.isprintable() and len(text) < 1000 for text in node.said), node.said
    if left is not None:
        tried(lambda: OdometryAnchor.from_state(left).is_continuous_with(10**18, np.zeros(3)))


def last_pose(folder: Path) -> State:
    return OdometryAnchor(10**18, np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.2, 0.3])).state()


SOURCES = (
    Source('bag', whole_bags, read_damaged_bag),
    Source('bag_bodies', drive_messages, read_strange_bodies),
    Source('states', explored, use_changed_state),
    Source('archives', explored_archives, load_damaged_archive),
    Source('checkpoint', last_pose, go_on_from_what_was_left),
)
