"""What begins and ends each kind of fault."""

import math
import signal
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from std_srvs.srv import Trigger

from benchmarks.faults.kinds import KILL, STOP, Fault
from benchmarks.faults.observer import Observer
from benchmarks.node_processes import NODES, Processes
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.drives import random_start
from thinmap_ros.sim.world import World

_CARRIED_M = 1.5
_PLACES = 100  # that are tried, in a world that may be smaller


class Cause(Protocol):
    """A fault of one kind: begun, ended after its duration, and what it found wrong by then."""

    def begin(self) -> None:
        """Begin the fault."""

    def is_done(self) -> bool:
        """Whether it may end; called again and again."""

    def end(self) -> list[str]:
        """End the fault; returns what must not happen, in words."""


class StreamCause:
    """The relay falsifies messages."""

    def __init__(self, fault: Fault, observer: Observer) -> None:
        self._fault = fault
        self._observer = observer

    def begin(self) -> None:
        """Begin the fault."""
        self._observer.order(begin=self._fault.kind.name, seed=self._fault.seed)

    def is_done(self) -> bool:
        """Whether it may end."""
        return True

    def end(self) -> list[str]:
        """End the fault."""
        self._observer.order(end=True)
        return []


class Stopped:
    """A node computes nothing for a while."""

    def __init__(self, node: str, processes: Processes) -> None:
        self._node = node
        self._processes = processes

    def begin(self) -> None:
        """Stop the process."""
        self._processes.send(self._node, signal.SIGSTOP)

    def is_done(self) -> bool:
        """Whether it may end."""
        return True

    def end(self) -> list[str]:
        """Let it continue."""
        self._processes.send(self._node, signal.SIGCONT)
        return []


class Killed:
    """A node is killed and started again. forgets: its checkpoint is removed in between."""

    def __init__(self, node: str, processes: Processes, forgets: bool = False) -> None:
        self._node = node
        self._processes = processes
        self._forgets = forgets

    def begin(self) -> None:
        """Kill the process."""
        self._processes.kill(self._node)

    def is_done(self) -> bool:
        """Whether it may end."""
        return True

    def end(self) -> list[str]:
        """Start it again."""
        if self._forgets:
            self._processes.forget(self._node)
        self._processes.start_node(self._node)
        return []


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


class Asked:
    """A peer asks a node for something that it must do, or must refuse."""

    def __init__(self, ask: Callable[[], Request], judge: Callable[[Any], list[str]]) -> None:
        """judge: what is wrong with a response, in words; None: there was none."""
        self._ask = ask
        self._judge = judge
        self._request: Request | None = None

    def begin(self) -> None:
        """Ask."""
        self._request = self._ask()

    def is_done(self) -> bool:
        """Whether there is an answer."""
        return self._request is not None and self._request.answer() is not None

    def end(self) -> list[str]:
        """Judge the answer."""
        if self._request is None:
            return []
        answer = self._request.answer()
        self._request.close()
        return self._judge(answer)


class Carried:
    """The robot is kidnapped; its wheels do not turn."""

    def __init__(self, seed: int, world: World, observer: Observer) -> None:
        self._seed = seed
        self._world = world
        self._observer = observer

    def begin(self) -> None:
        """Put it elsewhere."""
        place = self._observer.track.place
        place = self._world.start if place is None else place
        rng = np.random.default_rng(self._seed)
        self._observer.teleport(place_apart(self._world, place, rng))

    def is_done(self) -> bool:
        """Whether it may end."""
        return True

    def end(self) -> list[str]:
        """It stays there."""
        return []


def place_apart(world: World, place: Array, rng: np.random.Generator) -> Array:
    """A clear pose (3,) at least 1.5 m from another, if there is room."""
    found = random_start(world, rng)
    for _ in range(_PLACES):
        if math.dist(found[:2], place[:2]) >= _CARRIED_M:
            break
        found = random_start(world, rng)
    return found


def sim_time_request(node: Node, name: str) -> Request:
    """Ask a node of the run to leave simulated time, which all others keep."""
    value = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=False)
    parameter = Parameter(name='use_sim_time', value=value)
    request = SetParameters.Request(parameters=[parameter])
    return Request(node, SetParameters, f'{name}/set_parameters', request)


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
    if kind.signal == STOP:
        return Stopped(kind.node, processes)
    if kind.signal == KILL or kind.name == 'forget_localizer':
        return Killed(kind.node, processes, forgets=kind.signal != KILL)
    if kind.name == 'reset_localizer':
        return Asked(
            lambda: Request(observer.node, Trigger, 'localizer/reset', Trigger.Request()),
            reset_faults,
        )
    if kind.name == 'use_sim_time':
        name = NODES[fault.seed % len(NODES)]
        return Asked(
            lambda: sim_time_request(observer.node, name),
            lambda response: sim_time_faults(name, response),
        )
    if kind.name == 'carried_off':
        return Carried(fault.seed, world, observer)
    return StreamCause(fault, observer)
