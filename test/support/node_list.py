"""All nodes of the package, and the parameters that they have in common."""

import dataclasses
import importlib
from pathlib import Path

import rclpy

ROOT = Path(__file__).resolve().parents[2]

# All except the one that runs the others.
NODES = sorted(
    path.stem
    for path in (ROOT / 'thinmap_ros' / 'nodes').glob('[a-z]*.py')
    if path.stem != 'thinmap'
)

# Parameters that rclpy declares in every node.
OF_EVERY_NODE = {'start_type_description_service'}

# Parameters that must not have their defaults here: an existing bag, no window.
NEEDED = {'bag_player': {'bag': 'some_bag'}, 'rerun_viewer': {'spawn': False}}

OWN_WORDS = {'use_sim_time': 'Follow /clock instead of the time of the machine.'}


def node_class(name):
    module = importlib.import_module(f'thinmap_ros.nodes.{name}')
    classes = [
        c for c in vars(module).values() if isinstance(c, type) and c.__module__ == module.__name__
    ]
    (found,) = [c for c in classes if issubclass(c, rclpy.node.Node)]
    return found


def default_of(name, key):
    """Default of a field of the config in a node's module."""
    module = importlib.import_module(f'thinmap_ros.nodes.{name}')
    configs = [
        c
        for c in vars(module).values()
        if dataclasses.is_dataclass(c) and c.__module__ == module.__name__
    ]
    (default,) = [
        field.default for c in configs for field in dataclasses.fields(c) if field.name == key
    ]
    return default
