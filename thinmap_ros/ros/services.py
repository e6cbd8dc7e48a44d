"""Services that answer with success and a message, and how one node asks another for them."""

from collections.abc import Callable
from typing import Any

from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from thinmap_ros.core.errors import ThinmapError

_LIMIT_S = 10.0


def fill_response(response: Any, work: Callable[[], str]) -> Any:
    """Fill in a response: success and what `work` says that it did, or what kept it from that."""
    try:
        response.message = work()
        response.success = True
    except (ThinmapError, OSError) as error:
        response.message = str(error)
        response.success = False
    return response


async def call(node: Node, client: Client, request: Any) -> Any | None:
    """Answer of another node's service.

    None where nobody offers it, success = false where no answer comes in time.

    For callbacks that are coroutines. The client needs a callback group that the one who waits does
    not keep busy. The time is that of the machine: a simulated one may stand still.
    """
    if not client.service_is_ready():
        return None
    future = client.call_async(request)
    wall = Clock(clock_type=ClockType.STEADY_TIME)
    timer = node.create_timer(
        _LIMIT_S, future.cancel, callback_group=client.callback_group, clock=wall
    )
    await future
    node.destroy_timer(timer)
    if not future.cancelled():
        return future.result()
    client.remove_pending_request(future)
    return client.srv_type.Response(
        message=f'{client.srv_name}: no answer within {_LIMIT_S:.0f} s', success=False
    )
