"""All nodes of the package, and the parameters that they have in common."""

import dataclasses
import importlib
from pathlib import Path

import rclpy

from thinmap_ros.core.slam.localizer import parameters_elsewhere
from thinmap_ros.core.stage import SCAN_MATCHING

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

# Another value of a parameter with which a node declares other parameters.
VARIANTS = {'localizer': {'slam': 'ekf_ti'}}

OWN_WORDS = {'use_sim_time': 'Follow /clock instead of the time of the machine.'}


def node_class(name):
    module = importlib.import_module(f'thinmap_ros.nodes.{name}')
    classes = [
        c for c in vars(module).values() if isinstance(c, type) and c.__module__ == module.__name__
    ]
    (found,) = [c for c in classes if issubclass(c, rclpy.node.Node)]
    return found


def only_in(names, others):
    """Names of parameters that are not among the others, a group once if it is wholly missing."""
    groups = {other.partition('.')[0] for other in others if '.' in other}
    missing = [name for name in names if name not in others]
    heads = [name.partition('.')[0] for name in missing]
    pairs = zip(missing, heads, strict=True)
    return list(dict.fromkeys(name if head in groups else head for name, head in pairs))


def variant_text(names, others, quote=''):
    """Which parameters hold for the usual localizer, and that others follow; quote: around names.

    names, others: of the parameters that it declares, and those with another value of slam.
    """
    (condition,) = {parameters_elsewhere(SCAN_MATCHING)[n] for n in others if n not in names}
    missing = [f'{quote}{name}{quote}' for name in only_in(names, others)]
    return f'With {condition} there are no {", ".join(missing[:-1])} and {missing[-1]}, but:'


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
