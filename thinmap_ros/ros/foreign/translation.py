"""What a node was given, before it declares its parameters: in order, and by their own names."""

import sys

from rclpy.node import Node
from rclpy.parameter import Parameter

from thinmap_ros.ros.foreign.sections import foreign_values, given_files, overruled_values
from thinmap_ros.ros.foreign.values import translated
from thinmap_ros.ros.private_rclpy import given_parameters

_CLOCK = 'use_sim_time'


def translate(node: Node, program: str) -> None:
    """Give a node what was given last, and its own parameters for those of other packages.

    program: name of the node before remapping. Sections of parameter files for the nodes that it
    replaces are read, too. Raises InputError where a parameter file is none.
    """
    given = given_parameters(node)
    for name, value in overruled_values(sys.argv, node.get_fully_qualified_name()).items():
        given[name] = Parameter(name, value=value)
    for file in given_files(sys.argv):
        for name, value in foreign_values(file, program, node.get_namespace()).items():
            if value is not None:
                given.setdefault(name, Parameter(name, value=value))
    if _CLOCK in given:
        # Of a foreign section: the node has declared it before.
        node.set_parameters([given[_CLOCK]])
    own = translated(program, {name: parameter.value for name, parameter in given.items()})
    for name in given.keys() - own.keys():
        del given[name]
    for name in own.keys() - given.keys():
        given[name] = Parameter(name, value=own[name])
