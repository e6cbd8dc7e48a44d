"""What the nodes of a robot share: lifecycle, pause, reset, checkpoint, time jump, a worker."""

import inspect
import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from time import monotonic, thread_time
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.clock import Clock
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.timer import Timer
from std_srvs.srv import SetBool, Trigger

from thinmap_ros.core.errors import ThinmapError, one_line_reason
from thinmap_ros.core.snapshot import State
from thinmap_ros.kernels import release_free_pages
from thinmap_ros.ros import parameters
from thinmap_ros.ros.checkpoint import Checkpoint
from thinmap_ros.ros.diagnostics import OK, NodeDiagnostics
from thinmap_ros.ros.private_rclpy import RCLError
from thinmap_ros.ros.services import offer
from thinmap_ros.ros.sole_source import follow_one_clock
from thinmap_ros.ros.time_jumps import STEADY, ElapsedTime, TimeJumps

_CHECKPOINT_PERIOD_S = 0.5
_DEAR_INTERVAL = 200.0  # half a percent of the time
POLL_S = 0.1  # between two looks at long work

# Processes what long work has found, in the thread of the node.
Result = Callable[[], None]


class ThinmapNode(LifecycleNode):
    """A lifecycle node that activates itself: unconfigured, inactive, active, finalized.

    Everything is created in the constructor. Only an active node processes messages, runs its
    timers and accepts goals; of a latched topic it processes the last message when it becomes
    active. `reset_state` discards what was learned: on clean-up, by the service ~/reset, and when
    the clock jumps back.
    """

    def __init__(self, name: str, recovers: bool = False) -> None:
        """Create a node; one that recovers calls `enable_checkpoint` at the end of its own.

        name: before remapping, kept as `program`.
        """
        super().__init__(name)
        self.program = name
        parameters.translate(self, name)
        parameters.declare_strict(self)
        self._autostart = bool(
            parameters.declare_parameter(
                self, 'autostart', True, 'Become active at once. false: wait for transitions.'
            )
        )
        self._recovery_timeout_s = parameters.declare_recovery(self) if recovers else 0.0
        self.diagnostics = NodeDiagnostics(self)
        follow_one_clock(self, self.diagnostics)
        self.is_active = False
        self.is_paused = False
        self.time_jumps = TimeJumps(self.get_clock())
        self.elapsed_time = ElapsedTime(self.get_clock())
        self._checkpoints: list[Checkpoint] = []
        self._checkpoint_timer: Timer | None = None
        self._activation_callbacks: list[Callable[[], None]] = []
        self._end_callbacks: list[Callable[[], None]] = []
        self._failure_callbacks: list[Callable[[], None]] = []
        self.diagnostics.add_update_callback(self.handle_time_jump)
        offer(self.create_service, Trigger, '~/reset', self._on_reset)
        self._reject_invalid_transitions()

    @property
    def now_ns(self) -> int:
        """Time by the clock of the node, simulated or not, ns."""
        return int(self.get_clock().now().nanoseconds)

    def start(self) -> None:
        """Become active, unless `autostart` is false."""
        if self._autostart:
            self.trigger_configure()
            self.trigger_activate()
            self.get_logger().info('ready')
        else:
            self.diagnostics.set_state(OK, 'unconfigured')
            self.get_logger().info('unconfigured: waits for transitions')

    def reset_state(self) -> None:
        """Discard what was learned from messages."""

    def stop(self) -> None:
        """Stop motion and end goals: the node is deactivated or reset."""

    def create_pause_service(self) -> None:
        """Create ~/pause: while paused, the node ignores new scans."""
        offer(self.create_service, SetBool, '~/pause', self._on_pause)

    def create_active_timer(
        self, period_s: float, work: Callable[[], None], clock: Clock | None = None
    ) -> Timer:
        """Create a timer that calls `work` while the node is active.

        clock: that of `elapsed_time`, if none is given.
        """

        def guarded() -> None:
            self.handle_time_jump()
            if self.is_active:
                work()

        return self.create_timer(period_s, guarded, clock=clock or self.elapsed_time.timer_clock)

    def create_active_service(
        self, kind: Any, name: str, work: Callable[[Any, Any], Any], **options: Any
    ) -> None:
        """Create a service that is refused while the node is not active, and has nothing to give.

        work: returns the response to request and response, or is a coroutine. options: as of
        `create_service`. A response without `success` stays empty, as that of Nav2's map_server.
        """

        async def guarded(request: Any, response: Any) -> Any:
            if self.is_active:
                answer = work(request, response)
                return await answer if inspect.isawaitable(answer) else answer
            reason = f'{name}: {self.get_name()} is not active: expected it to be activated first'
            self.get_logger().warning(reason)
            if hasattr(response, 'success'):
                response.success = False
                response.message = reason
            return response

        self.create_service(kind, name, guarded, **options)

    def enable_checkpoint(
        self,
        state: Callable[[], State | None],
        restore: Callable[[State], None],
        dear_state: Callable[[], State | None] = lambda: None,
    ) -> None:
        """Restore the checkpoint of a killed predecessor, and save one periodically from now on.

        It is saved after what may have changed the state: see `touch`.

        state: returns what to save; None: nothing. dear_state: the rest, which takes long to save:
        it is older than the other. restore: is called with both of a node that was killed less than
        `recovery_timeout_s` ago. Where it raises a ThinmapError, as for a node that was started
        with other parameters, the node starts empty.
        """
        limit_s = self._recovery_timeout_s
        file = Checkpoint(self, limit_s, state)
        dear = Checkpoint(
            self, limit_s and math.inf, dear_state, ending='.dear', interval=_DEAR_INTERVAL
        )
        self._checkpoints = [dear, file]
        self._checkpoint_timer = self.create_timer(
            _CHECKPOINT_PERIOD_S,
            self._save_checkpoints,
            clock=STEADY,
        )
        self.diagnostics.add_update_callback(self._renew_checkpoints)
        saved = file.load()
        if saved is None:
            return
        try:
            restore({**(dear.load() or {}), **saved})
        except ThinmapError as error:
            self.get_logger().warning(
                f'checkpoint rejected: {one_line_reason(error)}: starting empty'
            )
            self._reset()
        else:
            self.get_logger().warning('restored the state of a killed node; ~/reset discards it')

    def close(self) -> None:
        """Delete the checkpoint: the node ends in order."""
        for checkpoint in self._checkpoints:
            checkpoint.delete()

    def touch(self) -> None:
        """The state may have changed: checkpoints are saved again.

        It is called after each callback of the node but those of timers, which call it themselves.
        """
        for checkpoint in self._checkpoints:
            checkpoint.is_outdated = True
        if self._checkpoint_timer is not None and self._checkpoint_timer.is_canceled():
            self._checkpoint_timer.reset()

    def _save_checkpoints(self) -> None:
        outdated = [checkpoint for checkpoint in self._checkpoints if checkpoint.is_outdated]
        are_saved = [checkpoint.save_if_due() for checkpoint in outdated]
        if all(are_saved) and self._checkpoint_timer is not None:
            self._checkpoint_timer.cancel()

    def _renew_checkpoints(self) -> None:
        for checkpoint in self._checkpoints:
            checkpoint.renew()

    def checkpoint_now(self) -> bool:
        """Save a checkpoint before a change is published; returns whether there was time."""
        saved = [checkpoint.save_if_due(is_urgent=True) for checkpoint in self._checkpoints]
        return bool(saved) and all(saved)

    def add_activation_callback(self, work: Callable[[], None]) -> None:
        """Call `work` each time that the node becomes active."""
        self._activation_callbacks.append(work)

    def add_end_callback(self, work: Callable[[], None]) -> None:
        """Call `work` when the process ends in order, before `close`."""
        self._end_callbacks.append(work)

    def add_failure_callback(self, work: Callable[[], None]) -> None:
        """Call `work` each time that a step of the node has failed."""
        self._failure_callbacks.append(work)

    def step_failed(self, step: str, error: Exception) -> None:
        """Report a step that an error has ended, which nobody expects; the node continues.

        step: what was processed, with its stamp if it has one.
        """
        for work in self._failure_callbacks:
            work()
        self.diagnostics.step_failed(step, error)

    def end(self) -> None:
        """The process ends in order."""
        for work in self._end_callbacks:
            work()

    def handle_time_jump(self) -> None:
        """Reset the state if the clock has jumped back: before messages of the new time."""
        if self.time_jumps.pop():
            self.diagnostics.count_drops('state reset: clock jumped back', 1)
            self.reset('clock jumped back')

    def reset(self, reason: str) -> None:
        """Reset the state as ~/reset does, and say why."""
        self.get_logger().warning(f'{reason}: state reset')
        self._reset()

    def _reset(self) -> None:
        self.stop()
        self.close()
        self.reset_state()

    # Lifecycle.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Become inactive."""
        self.diagnostics.set_state(OK, 'inactive')
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Process messages from now on."""
        self.is_active = True
        self.diagnostics.set_state(OK, 'running')
        for work in self._activation_callbacks:
            work()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop motion and ignore messages."""
        self.is_active = False
        self.stop()
        self.diagnostics.set_state(OK, 'inactive')
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Discard the state."""
        self._reset()
        self.diagnostics.set_state(OK, 'unconfigured')
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop for good; the process itself ends with a signal."""
        self.is_active = False
        self.stop()
        self.diagnostics.set_state(OK, 'finalized')
        return super().on_shutdown(state)

    def _reject_invalid_transitions(self) -> None:
        """Reject a transition that the state does not have; rclpy would end the node."""
        service = self._service_change_state
        change = service.callback

        def guarded(
            request: ChangeState.Request, response: ChangeState.Response
        ) -> ChangeState.Response:
            try:
                return change(request, response)
            except RCLError as error:
                self.get_logger().warning(f'transition {request.transition.id} rejected: {error}')
                response.success = False
                return response

        service.callback = guarded

    # Services.

    def _on_reset(self, _: Trigger.Request) -> str:
        self._reset()
        return 'state reset'

    def _on_pause(self, request: SetBool.Request) -> str:
        self.is_paused = request.data
        self.diagnostics.set_paused(self.is_paused)
        return 'scans are ignored' if self.is_paused else 'scans are processed'


class Worker:
    """A thread for long work of a node: one thing after another, in a share of a core.

    No scan waits for it. The node processes its results in its own thread, while it is active.
    """

    def __init__(
        self, node: ThinmapNode, share: float, on_error: Callable[[Exception], None]
    ) -> None:
        """share: of the time of a core that the work may take, 0 to 1.

        on_error: receives a ThinmapError or OSError of the work, in the thread of the node.
        """
        self._node = node
        self._share = share
        self._on_error = on_error
        self._thread = ThreadPoolExecutor(1, thread_name_prefix='worker')
        self._job: Future[Result] | None = None
        self._rests_until_s = 0.0
        # Only while there is work.
        self._poll = node.create_active_timer(POLL_S, self._process_result, clock=STEADY)
        self._poll.cancel()

    @property
    def is_busy(self) -> bool:
        """Whether there is work whose result is not processed yet."""
        return self._job is not None

    @property
    def is_resting(self) -> bool:
        """Whether the last work took so long that the next has to wait."""
        return monotonic() < self._rests_until_s

    def begin(self, work: Callable[[], Result]) -> None:
        """Begin to work, after all that was begun before."""
        self._job = self._thread.submit(self._timed, work)
        self._poll.reset()

    def drop(self) -> None:
        """Ignore what the present work finds."""
        self._job = None

    def close(self) -> None:
        """Wait until what was begun is done."""
        self._thread.shutdown()

    def _timed(self, work: Callable[[], Result]) -> Result:
        began_s = thread_time()
        try:
            return work()
        finally:
            # Work on a large map takes, and frees, a hundred bytes a cell.
            release_free_pages()
            used_s = thread_time() - began_s
            self._rests_until_s = monotonic() + used_s * (1.0 / self._share - 1.0)

    def _process_result(self) -> None:
        job = self._job
        if job is not None and not job.done():
            return
        self._poll.cancel()
        self._job = None
        if job is None:
            return
        self._node.touch()
        try:
            job.result()()
        except (ThinmapError, OSError) as error:
            self._on_error(error)
