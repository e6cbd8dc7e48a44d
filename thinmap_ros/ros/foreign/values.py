"""Translation of given values of other packages' parameters."""

from collections.abc import Mapping
from typing import Any

from thinmap_ros.ros.foreign.tables import PACKAGES, ForeignParameter

_SEED = 'random_seed'  # negative: AMCL takes one from the clock


def translated(program: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Values by the names of a node's own parameters, for those of other packages.

    program: name of the node before remapping. A parameter that is given by its own name, too,
    keeps that value. A list of values is split among the parameters that it stands for.
    """
    own_values = dict(given)
    for foreign in _understood(program):
        if foreign.name not in given:
            continue
        own = [name for owner, name in foreign.targets if owner == program]
        value = given[foreign.name]
        values = list(value) if isinstance(value, list | tuple) else len(own) * [value]
        if foreign.name not in own:
            del own_values[foreign.name]
        if foreign.name == _SEED and isinstance(value, int) and value < 0:
            continue
        for name, single in zip(own, values, strict=False):
            own_values.setdefault(name, single)
    return own_values


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
