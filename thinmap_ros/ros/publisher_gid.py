"""Who published a message: the GID of its publisher, which rclpy of Jazzy does not pass on."""

import ctypes
from collections.abc import Callable

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.type_support import check_is_valid_msg_type
from std_msgs.msg import Bool

_RCL = ctypes.CDLL('librcl.so')
GID_SIZE = 16  # RMW_GID_STORAGE_SIZE of Jazzy


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
    """Subscribe to a std_msgs/Bool as `Node.create_subscription` does.

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
