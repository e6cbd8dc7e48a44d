"""What the nodes of a robot share: lifecycle, diagnostics, pause, reset, checkpoint, time jump."""

from collections.abc import Callable
from time import monotonic

from lifecycle_msgs.srv import ChangeState
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.timer import Timer
from std_srvs.srv import SetBool, Trigger

from thinmap_ros.core.errors import ThinmapError, reason_of
from thinmap_ros.ros import parameters
from thinmap_ros.ros.checkpoint import Checkpoint, State
from thinmap_ros.ros.diagnostics import OK, NodeDiagnostics
from thinmap_ros.ros.services import fill_response

_CHECKPOINT_PERIOD_S = 0.5
# Between two times of keeping, in times that it took.
_CHECKPOINT_DUTY = 50.0
_CHECKPOINT_DUTY_NOW = 10.0
RCLError = rclpy_implementation.RCLError
_SET_BACK = JumpThreshold(
    min_forward=None, min_backward=Duration(seconds=-1.0), on_clock_change=False
)


class ThinmapNode(LifecycleNode):
    """A node that walks through ROS's states by itself: unconfigured, inactive, active, finalized.

    Everything is set up on construction. Only an active node takes messages, works by its timers
    and takes goals; of a latched topic it takes the last message when it becomes active.
    `reset_state` forgets what was learned: on clean-up, by the service ~/reset, and when the clock
    is set back (a bag or a simulation started again).
    """

    def __init__(self, name: str, recovers: bool = False) -> None:
        """Make a node; one that recovers calls `keep` once it is set up."""
        super().__init__(name)
        self._autostart = bool(
            parameters.declare_parameter(
                self, 'autostart', True, 'become active at once; false: wait for transitions'
            )
        )
        self._recover_s = parameters.declare_recovery(self) if recovers else 0.0
        self.diagnostics = NodeDiagnostics(self)
        self.is_active = False
        self.is_paused = False
        self._set_back = False
        self.time_jumps = 0
        self._before_ns = self._back_ns = 0
        self._checkpoint: Checkpoint | None = None
        self._on_activation: list[Callable[[], None]] = []
        self._jumps = self.get_clock().create_jump_callback(_SET_BACK, post_callback=self._on_jump)
        self.diagnostics.add_update_callback(self.handle_time_jump)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self._reject_invalid_transitions()

    def start(self) -> None:
        """Become active, unless somebody else is to decide when."""
        if self._autostart:
            self.trigger_configure()
            self.trigger_activate()
        else:
            self.diagnostics.set_state(OK, 'unconfigured')

    def reset_state(self) -> None:
        """Forget what was learned from messages."""

    def stop(self) -> None:
        """End what is under way: the node is deactivated, or begins anew."""

    def create_pause_service(self) -> None:
        """Offer ~/pause: while it is on, the node takes no new scans."""
        self.create_service(SetBool, '~/pause', self._on_pause)

    def create_active_timer(
        self, period_s: float, work: Callable[[], None], clock: Clock | None = None
    ) -> Timer:
        """Work by a timer while the node is active."""

        def guarded() -> None:
            self.handle_time_jump()
            if self.is_active:
                work()

        return self.create_timer(period_s, guarded, clock=clock)

    def enable_checkpoint(
        self, state: Callable[[], State | None], resume: Callable[[State], None]
    ) -> None:
        """Keep what a state returns, again and again, for the case that the node is killed.

        state: returns None where there is nothing to keep. resume: is called with what a
        predecessor left that was killed a short time ago. Where it raises a ThinmapError, as the
        node was started with other parameters, the node begins anew.
        """
        self._checkpoint = Checkpoint(self, self._recover_s)
        self._state_of = state
        self._checkpoint_time = monotonic()
        self._checkpoint_duration_s = 0.0
        self.create_timer(
            _CHECKPOINT_PERIOD_S,
            self._save_checkpoint,
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        left = self._checkpoint.load()
        if left is None:
            return
        try:
            resume(left)
        except ThinmapError as error:
            refused = f'what it had is refused: {reason_of(error)}'
            self.get_logger().warning(f'was killed, but {refused}: begins anew')
            self._forget()
        else:
            self.get_logger().warning('was killed, goes on from what it had; ~/reset begins anew')

    def close(self) -> None:
        """Leave nothing behind: the node ends in order."""
        if self._checkpoint is not None:
            self._checkpoint.delete()

    def checkpoint_now(self) -> bool:
        """Keep the state before others hear what is new in it; returns whether there was time."""
        return self._save_checkpoint(_CHECKPOINT_DUTY_NOW)

    def _save_checkpoint(self, least_pauses: float = _CHECKPOINT_DUTY) -> bool:
        # However large the map: keeping it takes a small share of the time.
        now = monotonic()
        if (
            self._checkpoint is None
            or now - self._checkpoint_time < least_pauses * self._checkpoint_duration_s
        ):
            return False
        state = self._state_of()
        if state is not None:
            self._checkpoint.save(state)
        self._checkpoint_time = monotonic()
        self._checkpoint_duration_s = self._checkpoint_time - now
        return True

    def add_activation_callback(self, work: Callable[[], None]) -> None:
        """Have something done each time that the node becomes active."""
        self._on_activation.append(work)

    def handle_time_jump(self) -> None:
        """Begin anew if the clock was set back: before anything of the new time is taken."""
        if self._set_back:
            self._set_back = False
            self.time_jumps = self.time_jumps + 1
            self.get_logger().warning('the clock was set back: beginning anew')
            self.diagnostics.count_drops('begun anew: the clock was set back', 1)
            self._forget()

    def is_before_time_jump(self, stamp_ns: int) -> bool:
        """Whether a stamp is one of the last before the clock was set back."""
        return abs(self._before_ns - stamp_ns) < self._back_ns // 4

    def _on_jump(self, jump: TimeJump) -> None:
        # Only noted: whoever sets the clock must not be kept waiting.
        self._set_back = True
        self._back_ns = -jump.delta.nanoseconds
        self._before_ns = self.get_clock().now().nanoseconds + self._back_ns

    def _forget(self) -> None:
        self.stop()
        if self._checkpoint is not None:
            self._checkpoint.delete()
        self.reset_state()

    # States.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Be ready."""
        self.diagnostics.set_state(OK, 'inactive')
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take messages from now on."""
        self.is_active = True
        self.diagnostics.set_state(OK, 'running')
        for work in self._on_activation:
            work()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take no messages, and leave nothing moving."""
        self.is_active = False
        self.stop()
        self.diagnostics.set_state(OK, 'inactive')
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget everything."""
        self._forget()
        self.diagnostics.set_state(OK, 'unconfigured')
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop for good; the process ends with its signal, as always."""
        self.is_active = False
        self.stop()
        self.diagnostics.set_state(OK, 'finalized')
        return super().on_shutdown(state)

    def _reject_invalid_transitions(self) -> None:
        """Refuse a transition that there is not from a state: rclpy lets it end the node."""
        service = self._service_change_state
        change = service.callback

        def guarded(
            request: ChangeState.Request, response: ChangeState.Response
        ) -> ChangeState.Response:
            try:
                return change(request, response)
            except RCLError as error:
                self.get_logger().warning(f'transition {request.transition.id} is refused: {error}')
                response.success = False
                return response

        service.callback = guarded

    # Services.

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def work() -> str:
            self._forget()
            return 'begun anew'

        return fill_response(response, work)

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.is_paused = request.data
        self.diagnostics.set_paused(self.is_paused)
        return fill_response(
            response, lambda: 'no new scans are taken' if self.is_paused else 'scans are taken'
        )
