"""Files that come with the package: worlds, and texts of message definitions.

They lie in the package where pip installed it, beside it in the source tree, and in the share
folders of ROS where colcon installed it; they are looked for in this order.
"""

from collections.abc import Iterator
from importlib import resources, util
from pathlib import Path

from thinmap_ros.core.errors import InputError, did_you_mean, quoted
from thinmap_ros.files.safe import path_of

_PACKAGE = 'thinmap_ros'


def world_path(name: str | Path) -> Path:
    """Path of a world: an existing file, or the name of an installed world.

    Raises InputError, with the names of the installed worlds, if there is neither.
    """
    path = path_of(name)
    name = str(name)
    if path.is_file():
        return path
    worlds = _worlds()
    if name in worlds:
        return worlds[name]
    installed = ', '.join(sorted(worlds)) or 'none installed'
    meant = did_you_mean(name, worlds)
    raise InputError(f'world {quoted(name)}{meant}: expected a file, or one of {installed}')


def config_file(node: str) -> Path:
    """Path of the file with all parameters of a node. Raises InputError if it is not installed."""
    for folder in _folders(_PACKAGE, 'config'):
        if (file := folder / f'{node}.yaml').is_file():
            return file
    raise InputError(f'config/{node}.yaml: not installed')


def presets() -> dict[str, Path]:
    """Parameter files of robots by name."""
    folders = [folder for folder in _folders(_PACKAGE, 'config/robots') if folder.is_dir()]
    return {file.stem: file for folder in folders[:1] for file in sorted(folder.glob('*.yaml'))}


def message_definitions(package: str) -> dict[str, str]:
    """Texts of a package's message definitions by full name, for bags.

    Empty if the package is not available.
    """
    for folder in _folders(package, 'msg'):
        files = sorted(folder.glob('*.msg'))
        if files:
            return {f'{package}/msg/{file.stem}': file.read_text() for file in files}
    return {}


def _worlds() -> dict[str, Path]:
    """Worlds by name."""
    worlds: dict[str, Path] = {}
    for folder in _folders(_PACKAGE, 'worlds'):
        for file in folder.glob('*.yaml'):
            worlds.setdefault(file.stem, file)
    return worlds


def _folders(package: str, name: str) -> Iterator[Path]:
    """Where a folder of a package's data may be, the best place first."""
    yield Path(str(resources.files(_PACKAGE))) / 'data' / package / name
    source = Path(__file__).parents[2]
    yield source / name if package == _PACKAGE else source / package / name
    share = _share(package)
    if share is not None:
        yield share / name


def _share(package: str) -> Path | None:
    """Share folder of an installed ROS package; None without ROS or without the package."""
    if util.find_spec('ament_index_python') is None:
        return None
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    try:
        return Path(get_package_share_directory(package))
    except (PackageNotFoundError, OSError):  # OSError: no ROS is sourced
        return None
