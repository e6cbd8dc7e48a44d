"""Translation of the parameters of other packages before a node declares its own."""

from rclpy.node import Node
from rclpy.parameter import Parameter

from thinmap_ros.ros.foreign.tables import PACKAGES, ForeignParameter

_SEED = 'random_seed'  # negative: AMCL takes one from the clock


def translate(node: Node, program: str) -> None:
    """Give a node its own parameters for those of other packages that it was started with.

    program: name of the node before remapping. A parameter that is given by its own name, too,
    keeps that value. A list of values is split among the parameters that it stands for.
    """
    # rclpy has no public way to change what was given.
    given = node._parameter_overrides
    for foreign in _understood(program):
        if foreign.name not in given:
            continue
        own = [name for owner, name in foreign.targets if owner == program]
        value = given[foreign.name].value
        values = list(value) if isinstance(value, list | tuple) else len(own) * [value]
        if foreign.name not in own:
            del given[foreign.name]
        if foreign.name == _SEED and isinstance(value, int) and value < 0:
            continue
        for name, single in zip(own, values, strict=False):
            given.setdefault(name, Parameter(name, value=single))


def is_known(name: str) -> bool:
    """Whether a node of thinmap, if not this one, takes this parameter of another package."""
    return any(
        foreign.name == name and foreign.targets
        for package in PACKAGES
        for foreign in package.parameters
    )


def _understood(program: str) -> list[ForeignParameter]:
    return [
        foreign
        for package in PACKAGES
        if program in package.nodes
        for foreign in package.parameters
        if any(owner == program for owner, _ in foreign.targets)
    ]
