"""What nodes need of rclpy and it has no public way to: all private names are here.

Tried with rclpy of Jazzy, 7.1: test/ros/test_private_rclpy.py tells when another one is installed.
"""

from typing import Any

from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future

# Raised by rcl. Without it, a node without keys or with a wrong transition ends in a traceback.
RCLError = rclpy_implementation.RCLError
# Raised for unknown arguments after --ros-args, which would end in a traceback, too.
UnknownROSArgsError = rclpy_implementation.UnknownROSArgsError


def given_parameters(node: Node) -> dict[str, Parameter]:
    """Parameters that a node was given, by name; what is changed here is what it declares.

    Without it: no warning of a misspelled name, no parameters of other packages, and an integer
    for a float is an error.
    """
    given: dict[str, Parameter] = node._parameter_overrides
    return given


def declared_names(node: Node) -> set[str]:
    """Names of the parameters that a node has declared.

    Without it: no warning of a misspelled name.
    """
    return set(node._parameters)


def adopt_goal(server: ActionServer, handle: ServerGoalHandle, goal_id: bytes) -> None:
    """Let a server know a goal that it has not accepted itself.

    What it does with a request for a goal, without the answer to it. Without it: a goal is lost
    when its node restarts.
    """
    future = Future()
    server._goal_handles[goal_id] = handle
    server._result_futures[goal_id] = future
    server.add_future(future)


def begin_goal(handle: ServerGoalHandle) -> None:
    """Make a goal EXECUTING: what the handle's `execute` does, without its coroutine.

    Without it: an executor that waits for the goal's coroutine is busy all the time.
    """
    event: Any = rclpy_implementation.GoalEvent.EXECUTE
    handle._update_state(event)
