"""Machine and commit of a measurement."""

import os
import platform
import subprocess
from pathlib import Path

from thinmap_ros.files.safe import read_text, write_text

_ROOT = Path(__file__).resolve().parents[2]
_PROVENANCE = 'provenance.txt'
_GIT_S = 10.0


def provenance(folder: Path | None = None) -> str:
    """One line of commit, processor, cores and Python: of a folder of results, else of this run."""
    if folder is not None and (folder / _PROVENANCE).exists():
        return read_text(folder / _PROVENANCE).strip()
    known = commit(_ROOT)
    words = [
        *([f'Commit {known}'] if known else []),
        _processor(),
        f'{os.cpu_count()} cores',
        f'Python {platform.python_version()}',
    ]
    return ', '.join(words)


def write_provenance(folder: Path) -> None:
    """Write the line of this run to a folder of results, for pages that are made of it later."""
    write_text(folder / _PROVENANCE, f'{provenance()}\n')


def commit(root: Path) -> str:
    """Short hash of the commit of a source tree; empty outside of git.

    Changes that are not committed are marked, but for those of docs, to which pages are written.
    """
    try:
        # The tree may be installed inside the repository of another project.
        if not _git(root, 'ls-files', 'thinmap_ros/evaluation'):
            return ''
        changes = _git(root, 'status', '--porcelain', '-uno', '--', '.', ':(exclude)docs')
        return _git(root, 'rev-parse', '--short', 'HEAD') + (
            ' with local changes' if changes else ''
        )
    except (OSError, subprocess.SubprocessError):
        return ''


def _git(root: Path, *words: str) -> str:
    command = ['git', '-C', str(root), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_GIT_S, check=True)
    return done.stdout.strip()


def _processor() -> str:
    lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return names[0] if names else platform.processor()
