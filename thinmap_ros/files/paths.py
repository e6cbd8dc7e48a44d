"""Paths as callers give them."""

from pathlib import Path

from thinmap_ros.core.errors import InputError, quoted


def path_of(value: object) -> Path:
    """Path of a text or a Path. Raises InputError for anything else."""
    if isinstance(value, str | Path):
        return Path(value)
    raise InputError(f'path = {quoted(value)}: expected a text or a Path')
