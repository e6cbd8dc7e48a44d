"""What nodes need of rclpy and it has no public way to: all private names but the executor's.

Tried with rclpy of Jazzy, 7.1: test/ros/test_private_rclpy.py tells when another one is installed.
"""

import ctypes
from collections.abc import Callable, Iterable
from typing import Any

from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.type_support import check_is_valid_msg_type
from std_msgs.msg import Bool

# Raised by rcl. Without it, a node without keys or with a wrong transition ends in a traceback.
RCLError = rclpy_implementation.RCLError
# Raised for unknown arguments after --ros-args, which would end in a traceback, too.
UnknownROSArgsError = rclpy_implementation.UnknownROSArgsError
# Without them, no executor but those of rclpy.
InvalidHandle = rclpy_implementation.InvalidHandle
WaitSet = rclpy_implementation.WaitSet
_RCL = ctypes.CDLL('librcl.so')
GID_SIZE = 16  # RMW_GID_STORAGE_SIZE of Jazzy


def given_parameters(node: Node) -> dict[str, Any]:
    """The `Parameter`s that a node was given, by name; what is changed here is what it declares.

    Without it: no warning of a misspelled name, no parameters of other packages, and an integer
    for a float is an error.
    """
    given: dict[str, Any] = node._parameter_overrides
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


def clock_subscription(node: Node) -> Subscription | None:
    """The subscription of /clock with which a node follows simulated time; None without.

    Without it: each node of a process takes each message of /clock.
    """
    subscription: Subscription | None = node._time_source._clock_sub
    return subscription


def share_clock(node: Node, others: Iterable[Node]) -> Subscription:
    """Have a node's subscription of /clock set the clocks of others, which lose theirs.

    No executor of the node waits for it any longer. Without it: as above.
    """
    source = node._time_source
    for other in others:
        other.destroy_subscription(other._time_source._clock_sub)
        other._time_source._clock_sub = None
        source.attach_clock(other.get_clock())
    subscription: Subscription = source._clock_sub
    node._subscriptions.remove(subscription)
    for handler in subscription.event_handlers:
        node.remove_waitable(handler)
    return subscription


class _Gid(ctypes.Structure):
    """rmw_gid_t."""

    _fields_ = (
        ('implementation', ctypes.c_char_p),
        ('data', ctypes.c_uint8 * GID_SIZE),
    )


class _MessageInfo(ctypes.Structure):
    """rmw_message_info_t."""

    _fields_ = (
        ('source_timestamp', ctypes.c_int64),
        ('received_timestamp', ctypes.c_int64),
        ('publication_sequence_number', ctypes.c_uint64),
        ('reception_sequence_number', ctypes.c_uint64),
        ('publisher_gid', _Gid),
        ('from_intra_process', ctypes.c_bool),
    )


class _Handle(rclpy_implementation.Subscription):
    """A subscription to std_msgs/Bool that takes the GID together with each message."""

    def take_message(self, kind: type, raw: bool) -> tuple[Bool, _MessageInfo] | None:
        """Called by the executor, as the method of rclpy."""
        value = ctypes.c_bool()  # the whole of a std_msgs__msg__Bool
        info = _MessageInfo()
        pointer = ctypes.c_void_p(self.pointer)
        if _RCL.rcl_take(pointer, ctypes.byref(value), ctypes.byref(info), None) != 0:
            return None
        return Bool(data=value.value), info


def subscribe_with_gid(
    node: Node,
    topic: str,
    on_message: Callable[[bool, bytes, tuple[int, int]], None],
    profile: QoSProfile,
) -> None:
    """Subscribe to a std_msgs/Bool as `Node.create_subscription` does, with who published it.

    Without it: the last message on the stop decides for all.

    on_message: receives the value, the GID of the publisher, as of
    `get_publishers_info_by_topic`, and the publisher's number and stamp (ns) of the message.
    """

    def received(message: Bool, info: _MessageInfo) -> None:
        sent = info.publication_sequence_number, info.source_timestamp
        on_message(bool(message.data), bytes(info.publisher_gid.data), sent)

    check_is_valid_msg_type(Bool)  # it loads the type support
    with node.handle:
        handle = _Handle(node.handle, Bool, topic, profile.get_c_qos_profile())
    group = node.default_callback_group
    # Publishers that offer less than the profile requests do not match: no warning.
    events = SubscriptionEventCallbacks(use_default_callbacks=False)
    subscription = Subscription(handle, Bool, topic, received, group, profile, False, events)
    group.add_entity(subscription)
    node._subscriptions.append(subscription)
    node._wake_executor()
