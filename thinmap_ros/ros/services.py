"""Services with the response `success` and `message`, offered and called; servers of actions."""

import traceback
from collections.abc import Callable
from typing import Any

from rclpy.client import Client
from rclpy.logging import get_logger
from rclpy.node import Node

from thinmap_ros.core.errors import ThinmapError, one_line_reason
from thinmap_ros.ros.time_jumps import STEADY

_TIMEOUT_S = 10.0


def offer(create: Callable[..., Any], kind: Any, name: str, work: Callable[[Any], str]) -> None:
    """Offer a service whose response has what `work` returns for a request, or its error.

    create: `create_service` of a node, or its `create_active_service`.
    """
    create(kind, name, lambda request, response: fill_response(response, lambda: work(request)))


def fill_response(response: Any, work: Callable[[], str]) -> Any:
    """Fill in a response: the message that `work` returns, or the error that it raises.

    The traceback of an error that nobody expects is in the log.
    """
    try:
        response.message = work()
        response.success = True
    except (ThinmapError, OSError) as error:
        response.message = str(error)
        response.success = False
    except Exception as error:
        response.message = f'failed: {type(error).__name__}: {one_line_reason(error)}'
        response.success = False
        get_logger('thinmap').error(traceback.format_exc())
    return response


async def call(node: Node, client: Client, request: Any) -> Any | None:
    """Response of another node's service, for callbacks that are coroutines.

    None where no node offers it; success = false where there is no answer in time. The callback
    group of the client must not be blocked by the waiting callback. The timeout is in time of the
    machine, as simulated time may stand still.
    """
    if not client.service_is_ready():
        return None
    future = client.call_async(request)
    timer = node.create_timer(
        _TIMEOUT_S, future.cancel, callback_group=client.callback_group, clock=STEADY
    )
    await future
    node.destroy_timer(timer)
    if not future.cancelled():
        return future.result()
    client.remove_pending_request(future)
    return client.srv_type.Response(
        message=f'{client.srv_name}: no answer within {_TIMEOUT_S:.0f} s', success=False
    )


def action_servers(node: Node, action: str) -> set[bytes]:
    """Ids of the servers of an action that the graph knows: of their status publishers."""
    infos = node.get_publishers_info_by_topic(f'{action}/_action/status')
    return {bytes(info.endpoint_gid) for info in infos}
