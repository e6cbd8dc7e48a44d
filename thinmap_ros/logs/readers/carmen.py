"""CARMEN logs, plain or gzip."""

from pathlib import Path

from thinmap_ros.core.errors import InputError
from thinmap_ros.logs.carmen import CarmenLog, is_carmen
from thinmap_ros.logs.log import Log, LogFormat, LogOptions


def _log(path: Path, options: LogOptions) -> Log:
    source = options.odometry_source
    if source not in ('', 'topic'):
        raise InputError(f'{path}: odometry source {source}: a CARMEN log has its own odometry')
    return CarmenLog(path, options.carmen, options.T_base_laser, options.laser)


FORMAT = LogFormat('a CARMEN log (plain or gzip)', is_carmen, _log)
