"""ROS message classes by name."""

import re
from importlib import import_module
from typing import Any

from thinmap_ros.core import validation as checks
from thinmap_ros.core.errors import InputError

# Nothing else is imported because a bag or a publisher names it.
_NAME = re.compile(r'([a-z]\w*)/msg/([A-Z]\w*)', re.ASCII)


def message_class(type_name: str) -> Any:
    """Class of a message type such as sensor_msgs/msg/LaserScan.

    Raises InputError where it is not installed.
    """
    parts = _NAME.fullmatch(type_name)
    if parts is None:
        raise InputError(f'message type {checks.short(type_name)}: expected PACKAGE/msg/NAME')
    try:
        return getattr(import_module(f'{parts[1]}.msg'), parts[2])
    except (ImportError, AttributeError) as error:
        raise InputError(f'message type {checks.short(type_name)}: not installed here') from error
