"""Data files of the package: worlds and message definitions."""

import contextlib
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

from thinmap_ros.core.errors import InputError, quoted


def world_path(name: str) -> Path:
    """Path of a world: an existing file, or the name of an installed world.

    Raises InputError, with the names of the installed worlds, if there is neither.
    """
    path = Path(name)
    if path.is_file():
        return path
    worlds = _worlds()
    if name in worlds:
        return worlds[name]
    installed = ', '.join(sorted(worlds)) or 'none installed'
    raise InputError(f'world {quoted(name)}: expected a file, or one of {installed}')


def message_definitions(package: str) -> dict[str, str]:
    """Texts of a package's message definitions by full name, for bags.

    Empty if the package is not available.
    """
    # The source tree: thinmap is not installed, or ROS is not sourced.
    folder = Path(__file__).parents[2] / package / 'msg'
    with contextlib.suppress(PackageNotFoundError, OSError):
        folder = Path(get_package_share_directory(package)) / 'msg'
    return {f'{package}/msg/{file.stem}': file.read_text() for file in sorted(folder.glob('*.msg'))}


def _worlds() -> dict[str, Path]:
    folders = [Path(__file__).parents[2] / 'worlds']
    # Otherwise the source tree: thinmap is not installed, or ROS is not sourced.
    with contextlib.suppress(PackageNotFoundError, OSError):
        folders.append(Path(get_package_share_directory('thinmap_ros')) / 'worlds')
    return {file.stem: file for folder in folders for file in folder.glob('*.yaml')}
