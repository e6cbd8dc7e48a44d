"""The executor of a node: it waits with one wait set as long as the node has the same entities.

That of rclpy collects them and makes a wait set twice for each callback, as the callback wakes it:
half of the CPU time of a live robot. What tells of other nodes' QoS is half of what there is to
wait for, and is in the wait set once a second.
"""

import inspect
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from threading import get_ident
from time import monotonic
from typing import Any, NamedTuple

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import EventHandler, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.waitable import NumberOfEntities

from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.ros.private_rclpy import InvalidHandle, WaitSet

_KINDS = ('timer', 'subscription', 'guard_condition', 'client', 'service')
_EVENT_PERIOD_S = 1.0


class Ready(NamedTuple):
    """A callback that can be called, and its timer, subscription, service or the like, if any."""

    call: Callable[[], object]
    entity: Any


class _Unawaited(MutuallyExclusiveCallbackGroup):
    def can_execute(self, entity: Any) -> bool:
        """Never."""
        return False


# Options of a subscription that wakes no executor: `take_all` takes what is in its queue. What is
# there ends each wait for events of its QoS, so it has none.
UNAWAITED: dict[str, Any] = {
    'callback_group': _Unawaited(),
    'event_callbacks': SubscriptionEventCallbacks(use_default_callbacks=False),
}


def take_all(subscription: Any) -> None:
    """Call a subscription for each message in its queue."""
    while _call_subscription(subscription):
        pass


class NodeExecutor(SingleThreadedExecutor):
    """Gives the callbacks of a node, in the order in which rclpy's executor calls them.

    A callback without `async` is called at once; all else is a task of rclpy.
    """

    def __init__(self, node: Node) -> None:
        super().__init__()
        self._node = node
        self._is_changed = True
        self._in_use = ExitStack()  # what is waited for is not destroyed meanwhile
        self._thread = 0  # that calls the callbacks
        self._entities: dict[str, dict[int, Any]] = {}  # by kind and pointer
        self._waitables: list[Any] = []
        self._events: list[EventHandler] = []
        self._events_s = -math.inf  # when they were last waited for
        self._cycle: Iterator[Ready] = iter(())
        self.add_node(node)

    def wake(self) -> None:
        """Wait no longer: the node has other entities, or a future is done.

        What a callback has destroyed is gone at once: its topic may come back with another type.
        """
        self._is_changed = True
        if get_ident() == self._thread:
            self._in_use.close()
        super().wake()

    def next_callback(self, timeout_s: float) -> Ready | None:
        """A callback that is ready now or within a time, s; None where there is none.

        Raises ExternalShutdownException once ROS is shut down.
        """
        self._thread = get_ident()
        ready = next(self._cycle, None)
        if ready is None:
            self._cycle = self._next_cycle(round(timeout_s * SECOND_NS))
            ready = next(self._cycle, None)
        return ready

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """As that of rclpy."""
        self._in_use.close()
        return bool(super().shutdown(timeout_sec))

    def _next_cycle(self, timeout_ns: int) -> Iterator[Ready]:
        """Tasks that are not done, then what has become ready: each is judged when its turn is."""
        with self._tasks_lock:
            tasks = [each for each in self._tasks if not (each[0].done() or each[0].cancelled())]
            self._tasks[:] = tasks
        for task, entity, _ in reversed(tasks):
            yield Ready(partial(_run, task), entity)
        self._require_ros()
        if self._is_changed:
            self._collect()
        waited = self._fill()
        self._wait_set.wait(timeout_ns)
        self._require_ros()
        pointers = {kind: self._wait_set.get_ready_entities(kind) for kind in _KINDS}
        if not any(pointers.values()):
            self._events_s = -math.inf  # one that has come ends each wait until it is taken
        for waitable in waited:
            is_gone = self._is_changed and waitable not in self._node.waitables
            if is_gone or not waitable.is_ready(self._wait_set):
                continue
            if self.can_execute(waitable):
                yield self._task_of(waitable, self._take_waitable)
        for kind in _KINDS:
            entities = self._entities[kind]
            for pointer in pointers[kind]:
                entity = entities.get(pointer)
                if entity is None:
                    continue
                if self.can_execute(entity):
                    yield self._call_of(kind, entity)
                elif kind == 'guard_condition':  # waiting has reset it
                    entity.trigger()

    def _require_ros(self) -> None:
        if not self._context.ok():
            raise ExternalShutdownException

    def _collect(self) -> None:
        """Prepare to wait for the entities that the node has now."""
        self._is_changed = False
        self._in_use.close()
        node = self._node
        lists = (node.timers, node.subscriptions, node.guards, node.clients, node.services)
        for kind, entities in zip(_KINDS, lists, strict=True):
            self._entities[kind] = {
                each.handle.pointer: each
                for each in entities
                if not isinstance(each.callback_group, _Unawaited) and self._uses(each.handle)
            }
        used = [each for each in node.waitables if self._uses(each)]
        self._waitables = [each for each in used if not isinstance(each, EventHandler)]
        self._events = [each for each in used if isinstance(each, EventHandler)]
        timers, subscriptions, guards, clients, services = map(len, self._entities.values())
        counts = NumberOfEntities(subscriptions, guards + 2, timers, clients, services)
        for waitable in used:
            counts += waitable.get_num_entities()
        self._in_use.enter_context(self._context.handle)
        self._wait_set = WaitSet(
            counts.num_subscriptions,
            counts.num_guard_conditions,
            counts.num_timers,
            counts.num_clients,
            counts.num_services,
            counts.num_events,
            self._context.handle,
        )

    def _uses(self, handle: Any) -> bool:
        """Keep a handle from being destroyed until `_collect`; whether it still exists."""
        try:
            self._in_use.enter_context(handle)
        except InvalidHandle:
            return False
        return True

    def _fill(self) -> list[Any]:
        """Fill the wait set: waiting empties it. Returns the waitables that are in it."""
        wait_set = self._wait_set
        wait_set.clear_entities()
        # Nothing but a task that waits keeps an entity from being executed.
        can_execute = self.can_execute if self._tasks else _always
        for kind, entities in self._entities.items():
            add = getattr(wait_set, f'add_{kind}')
            for entity in filter(can_execute, entities.values()):
                if kind == 'timer' and entity.is_canceled():
                    continue  # in simulated time each message of /clock would end the wait
                add(entity.handle)
        for guard in (self._guard, self._sigint_gc):
            wait_set.add_guard_condition(guard.handle)
        waited = self._waitables
        if monotonic() - self._events_s >= _EVENT_PERIOD_S:
            self._events_s = monotonic()
            waited = [*waited, *self._events]
        waited = list(filter(can_execute, waited))
        for waitable in waited:
            waitable.add_to_wait_set(wait_set)
        return waited

    def _call_of(self, kind: str, entity: Any) -> Ready:
        """The call of an entity that is ready."""
        direct = {'timer': _call_timer, 'subscription': _call_subscription}.get(kind)
        if direct is None or inspect.iscoroutinefunction(entity.callback):
            return self._task_of(entity, getattr(self, f'_take_{kind}'))
        return Ready(partial(direct, entity), entity)

    def _task_of(self, entity: Any, take: Callable[[Any], Any]) -> Ready:
        return Ready(partial(_run, self._make_handler(entity, self._node, take)), entity)


def _always(_entity: Any) -> bool:
    return True


def _call_timer(timer: Any) -> None:
    """Call a timer, unless it was cancelled or destroyed by another callback of this cycle."""
    try:
        with timer.handle:
            if not timer.handle.is_timer_ready():
                return
            timer.handle.call_timer()
    except InvalidHandle:
        return
    timer.callback()


def _call_subscription(subscription: Any) -> bool:
    """Take a message, unless the subscription was destroyed by another callback of this cycle.

    Returns whether there was one.
    """
    try:
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
    except InvalidHandle:
        return False
    if taken is None:
        return False
    is_plain = subscription._callback_type is subscription.CallbackType.MessageOnly
    subscription.callback(*(taken[:1] if is_plain else taken))
    return True


def _run(task: Any) -> None:
    """Run or resume a task; raises what it raises."""
    task()
    error = task.exception()
    if error is not None:
        raise error
