"""Files that come with the package."""

import contextlib
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

from thinmap_ros.core.errors import InputError, shown


def world_path(name: str) -> Path:
    """A world's file: a path as it is, or the name of one of the package's worlds.

    Raises InputError where there is neither, naming the worlds that there are.
    """
    path = Path(name)
    if path.is_file():
        return path
    worlds = _worlds()
    if name in worlds:
        return worlds[name]
    installed = ', '.join(sorted(worlds)) or 'none installed'
    raise InputError(f'world {shown(name)}: expected a file, or one of {installed}')


def message_definitions(package: str) -> dict[str, str]:
    """Texts of a package's message definitions by full name, for bags.

    Empty where the package is not there.
    """
    folder = (
        Path(__file__).parents[2] / package / 'msg'
    )  # from the source tree: not installed, or no ROS sourced
    with contextlib.suppress(PackageNotFoundError, OSError):
        folder = Path(get_package_share_directory(package)) / 'msg'
    return {f'{package}/msg/{file.stem}': file.read_text() for file in sorted(folder.glob('*.msg'))}


def _worlds() -> dict[str, Path]:
    folders = [Path(__file__).parents[2] / 'worlds']
    with contextlib.suppress(
        PackageNotFoundError, OSError
    ):  # from the source tree: not installed, or no ROS sourced
        folders.append(Path(get_package_share_directory('thinmap_ros')) / 'worlds')
    return {file.stem: file for folder in folders for file in folder.glob('*.yaml')}
