"""Two saved sessions merged on trial: a page sees the joint map before it is saved."""

import base64
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

from thinmap_ros.core.errors import InputError, ThinmapError, one_line, one_line_reason
from thinmap_ros.files.merging import MergedMap
from thinmap_ros.files.sessions import GRID, PARTS, REGIONS, load_edits, load_grid, load_topology
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.services import SaveDirectory
from thinmap_ros.web.pages import Board
from thinmap_ros.web.requests import is_name

_TIMEOUT_S = 600.0
_MAX_SESSIONS = 200
_MAX_PICTURE_BYTES = 4 << 20
_ITEM = 'merge'


class _Trial:
    """The program merge_sessions at work, in a folder of its own, which `drop` deletes."""

    def __init__(self, maps: list[str]) -> None:
        self._folder = TemporaryDirectory(prefix='thinmap-merge-')
        folder = Path(self._folder.name)
        self.stem = str(folder / 'merged')
        self._picture = folder / 'merged.png'
        self._log = folder / 'log'
        self._began_s = time.monotonic()
        program = ['nice', sys.executable, '-m', 'thinmap_ros.tools.merge_sessions', '--quiet']
        words = [*maps, '-o', self.stem, '--picture', str(self._picture)]
        with self._log.open('wb') as log:
            self._process = subprocess.Popen(
                [*program, *words], stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )

    @property
    def code(self) -> int | None:
        """Exit code; None while it works."""
        return self._process.poll()

    @property
    def is_overdue(self) -> bool:
        """Whether it takes too long."""
        return self.code is None and time.monotonic() - self._began_s > _TIMEOUT_S

    def lines(self) -> list[str]:
        """What it has said."""
        return self._log.read_text(errors='replace').splitlines()

    def picture(self) -> str:
        """The maps and the joint one, PNG in base64; '' where there is none, or a huge one."""
        try:
            content = self._picture.read_bytes()
        except FileNotFoundError:
            return ''
        return base64.b64encode(content).decode() if len(content) < _MAX_PICTURE_BYTES else ''

    def drop(self) -> None:
        """End the program, and delete what it has made."""
        self._process.kill()
        self._process.wait()
        self._folder.cleanup()


class SessionMerge:
    """Shows what two sessions of save_directory make together; saves it where it is wanted.

    The program runs in a process of its own and what it makes is saved in a thread, so that the
    node does not wait. One merge at a time.
    """

    def __init__(self, node: ThinmapNode, board: Board, tell: Callable[[str], None]) -> None:
        """Declare save_directory; tell: shows what has happened."""
        self._board = board
        self._tell = tell
        self._directory = SaveDirectory(node)
        self._trial: _Trial | None = None
        self._is_shown = False
        self._saver = ThreadPoolExecutor(1, thread_name_prefix='merge')
        self._saving: Future[str] | None = None

    def list_sessions(self) -> None:
        """Show the names of the sessions in the directory."""
        files = sorted(self._directory.path.glob(f'*{GRID.ending}'))
        names = [file.name.removesuffix(GRID.ending) for file in files]
        self._board.put('sessions', [name for name in names if is_name(name)][:_MAX_SESSIONS])

    def begin(self, first: str, second: str) -> None:
        """Merge two sessions on trial. Raises InputError where that is not possible now."""
        if self._trial is not None:
            raise InputError('merge: expected the last one to be saved or dropped')
        if first == second:
            raise InputError(f'merge: {first}: expected two sessions')
        paths = [self._directory.resolve(name) for name in (first, second)]
        for name, path in zip((first, second), paths, strict=True):
            if not GRID.exists(path):
                raise InputError(f'merge: {name}: expected a session of {self._directory.path}')
        self._trial = _Trial(paths)
        self._is_shown = False
        self._show('working', [f'{first} and {second} are merged'])

    def save(self, name: str) -> None:
        """Save the joint map. Raises InputError where there is none, or the name is taken."""
        trial = self._trial
        if trial is None or trial.code != 0 or self._saving is not None:
            raise InputError('merge: expected a joint map that is shown')
        path = self._directory.resolve_for_saving(name, GRID)
        if any(part.exists(path) for part in PARTS):
            raise InputError(f'merge: {name}: exists: expected a new name')
        self._saving = self._saver.submit(_save, trial.stem, path)

    def drop(self) -> None:
        """Forget the joint map, or the work on it."""
        if self._saving is not None:
            raise InputError('merge: is being saved')
        self._forget('', [])

    def tick(self) -> None:
        """Show what is done; called ten times a second."""
        if self._saving is not None and self._saving.done():
            self._end_saving(self._saving)
        elif self._trial is not None and not self._is_shown:
            self._watch(self._trial)

    def close(self) -> None:
        """End the work."""
        self._saver.shutdown()
        if self._trial is not None:
            self._trial.drop()

    def _watch(self, trial: _Trial) -> None:
        if trial.is_overdue:
            self._forget('failed', [f'not merged within {_TIMEOUT_S:.0f} s'])
        elif trial.code == 0:
            # Lines on the maps, without those on the files that are still to be saved.
            own = f'{self._directory.path}/'
            words = [line for line in trial.lines() if line.startswith(own)]
            self._show('shown', words, trial.picture())
            self._is_shown = True
        elif trial.code is not None:
            self._forget('failed', trial.lines()[-1:] or [f'ended with {trial.code}'])

    def _end_saving(self, saving: Future[str]) -> None:
        self._saving = None
        try:
            said = saving.result()
        except (ThinmapError, OSError) as error:
            self._tell(f'merge: {one_line_reason(error)}')
            return
        self._forget('saved', [said])
        self.list_sessions()

    def _forget(self, state: str, words: list[str]) -> None:
        if self._trial is not None:
            self._trial.drop()
        self._trial = None
        self._show(state, words)

    def _show(self, state: str, words: list[str], picture: str = '') -> None:
        own = f'{self._directory.path}/'
        shown = [one_line(line.replace(own, '')) for line in words]
        self._board.put(_ITEM, {'state': state, 'words': shown, 'picture': picture})


def _save(stem: str, path: str) -> str:
    """Save a merged session under another name, all files or none; returns what was written."""
    keep_out = load_edits(stem).keep_out
    merged = MergedMap(load_grid(stem), load_topology(stem), REGIONS.load(stem), keep_out, {}, [])
    return '; '.join(merged.save(path))
