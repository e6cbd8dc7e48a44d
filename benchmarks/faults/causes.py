"""What begins and ends each kind of fault."""

import math
import signal
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from std_srvs.srv import Trigger

from benchmarks.faults.kinds import STOP, Fault
from benchmarks.faults.observer import Observer
from benchmarks.node_processes import NODES, Processes
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.drives import random_start
from thinmap_ros.sim.world import World

_CARRIED_M = 1.5
_PLACES = 100  # that are tried, in a world that may be smaller


def _nothing() -> None:
    """Neither begins nor ends anything."""


@dataclass(frozen=True)
class Cause:
    """What begins a fault and, after its duration and as soon as it may, ends it.

    end: returns what must not happen, in words, where it can tell.
    """

    begin: Callable[[], None] = _nothing
    end: Callable[[], list[str] | None] = _nothing
    may_end: Callable[[], bool] = lambda: True


class Request:
    """A request to a service, which is sent as soon as it is found."""

    def __init__(self, node: Node, kind: Any, service: str, request: Any) -> None:
        self._node = node
        self._client = node.create_client(kind, service)
        self._request = request
        self._future: Any = None

    def answer(self) -> Any:
        """The response; None before."""
        if self._future is None and self._client.service_is_ready():
            self._future = self._client.call_async(self._request)
        return self._future.result() if self._future and self._future.done() else None

    def close(self) -> None:
        """Destroy the client."""
        self._node.destroy_client(self._client)


def _asked(request: Request, judge: Callable[[Any], list[str]]) -> Cause:
    """A peer asks a node for something that it must do, or must refuse.

    judge: what is wrong with a response, in words; None: there was none.
    """

    def end() -> list[str]:
        answer = request.answer()
        request.close()
        return judge(answer)

    return Cause(end=end, may_end=lambda: request.answer() is not None)


def place_apart(world: World, place: Array, rng: np.random.Generator) -> Array:
    """A clear pose (3,) at least 1.5 m from another, if there is room."""
    found = random_start(world, rng)
    for _ in range(_PLACES):
        if math.dist(found[:2], place[:2]) >= _CARRIED_M:
            break
        found = random_start(world, rng)
    return found


def sim_time_faults(name: str, response: Any) -> list[str]:
    """What is wrong with the response to a change of use_sim_time, in words."""
    if response is None:
        return [f'{name}: no answer to use_sim_time']
    return [f'{name}: accepted use_sim_time'] if response.results[0].successful else []


def reset_faults(response: Any) -> list[str]:
    """What is wrong with the response to a reset, in words."""
    if response is None:
        return ['localizer: no answer to a reset']
    return [] if response.success else [f'localizer: not reset: {response.message}']


def cause_of(fault: Fault, world: World, processes: Processes, observer: Observer) -> Cause:
    """What begins and ends a fault."""
    kind = fault.kind
    node = kind.node
    if kind.signal == STOP:
        return Cause(
            lambda: processes.send(node, signal.SIGSTOP),
            lambda: processes.send(node, signal.SIGCONT),
        )
    if kind.is_killed:

        def start() -> None:
            if kind.forgets:
                processes.forget(node)
            processes.start_node(node)

        return Cause(lambda: processes.kill(node), start)
    if kind.name == 'reset_localizer':
        reset = Request(observer.node, Trigger, 'localizer/reset', Trigger.Request())
        return _asked(reset, reset_faults)
    if kind.name == 'use_sim_time':
        name = NODES[fault.seed % len(NODES)]
        return _asked(_sim_time_request(observer.node, name), lambda r: sim_time_faults(name, r))
    if kind.name == 'carried_off':
        return Cause(lambda: _carry_off(fault.seed, world, observer))
    return Cause(
        lambda: observer.order(begin=kind.name, seed=fault.seed), lambda: observer.order(end=True)
    )


def _sim_time_request(node: Node, name: str) -> Request:
    """Ask a node of the run to leave simulated time, which all others keep."""
    value = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=False)
    parameter = Parameter(name='use_sim_time', value=value)
    request = SetParameters.Request(parameters=[parameter])
    return Request(node, SetParameters, f'{name}/set_parameters', request)


def _carry_off(seed: int, world: World, observer: Observer) -> None:
    """Put the robot elsewhere; its wheels do not turn."""
    place = world.start if observer.track.place is None else observer.track.place
    observer.teleport(place_apart(world, place, np.random.default_rng(seed)))
