"""ROS message classes by name."""

from importlib import import_module
from typing import Any

from thinmap_ros.core.errors import InputError


def message_class(type_name: str) -> Any:
    """Class of a message type such as sensor_msgs/msg/LaserScan. Raises InputError where it is not installed."""
    try:
        package, kind, name = type_name.split('/')
        return getattr(import_module(f'{package}.{kind}'), name)
    except (ValueError, ImportError, AttributeError) as error:
        raise InputError(f'message type {type_name}: not installed here') from error
