"""Translation of the parameters of other packages before a node declares its own."""

from rclpy.node import Node
from rclpy.parameter import Parameter

from thinmap_ros.ros.foreign.values import translated


def translate(node: Node, program: str) -> None:
    """Give a node its own parameters for those of other packages that it was started with.

    program: name of the node before remapping.
    """
    # rclpy has no public way to change what was given.
    given = node._parameter_overrides
    own = translated(program, {name: parameter.value for name, parameter in given.items()})
    for name in given.keys() - own.keys():
        del given[name]
    for name in own.keys() - given.keys():
        given[name] = Parameter(name, value=own[name])
