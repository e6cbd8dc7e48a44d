"""What all nodes left running on a robot share: states, health, pause, reset, time set back."""

from collections.abc import Callable
from time import monotonic

from lifecycle_msgs.srv import ChangeState
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.timer import Timer
from std_srvs.srv import SetBool, Trigger

from thinmap_ros.core.errors import ThinmapError, one_line_reason
from thinmap_ros.ros import parameters
from thinmap_ros.ros.checkpoint import Recovery, State
from thinmap_ros.ros.diagnostics import OK, Health
from thinmap_ros.ros.services import answer

_KEEP_S = 0.5
# Between two times of keeping, in times that it took.
_LEAST_PAUSES = 50.0
_LEAST_PAUSES_NEWS = 10.0
RCLError = rclpy_implementation.RCLError
_SET_BACK = JumpThreshold(
    min_forward=None, min_backward=Duration(seconds=-1.0), on_clock_change=False
)


class LiveNode(LifecycleNode):
    """A node that walks through ROS's states by itself: unconfigured, inactive, active, finalized.

    Everything is set up on construction. Only an active node takes messages, works by its timers
    and takes goals; of a latched topic it takes the last message when it becomes active.
    `begin_anew` forgets what was learned: on clean-up, by the service ~/reset, and when the clock
    is set back (a bag or a simulation started again).
    """

    def __init__(self, name: str, recovers: bool = False) -> None:
        """Make a node; one that recovers calls `keep` once it is set up."""
        super().__init__(name)
        self._autostart = bool(
            parameters.declare_value(
                self, 'autostart', True, 'become active at once; false: wait for transitions'
            )
        )
        self._recover_s = parameters.declare_recovery(self) if recovers else 0.0
        self.health = Health(self)
        self.is_active = False
        self.is_paused = False
        self._set_back = False
        self.set_backs = 0
        self._before_ns = self._back_ns = 0
        self._recovery: Recovery | None = None
        self._on_activation: list[Callable[[], None]] = []
        self._jumps = self.get_clock().create_jump_callback(_SET_BACK, post_callback=self._on_jump)
        self.health.before_telling(self.settle)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self._survive_wrong_transitions()

    def start(self) -> None:
        """Become active, unless somebody else is to decide when."""
        if self._autostart:
            self.trigger_configure()
            self.trigger_activate()
        else:
            self.health.state(OK, 'unconfigured')

    def begin_anew(self) -> None:
        """Forget what was learned from messages."""

    def stand_still(self) -> None:
        """End what is under way: the node is deactivated, or begins anew."""

    def offer_pause(self) -> None:
        """Offer ~/pause: while it is on, the node takes no new scans."""
        self.create_service(SetBool, '~/pause', self._on_pause)

    def every(self, period_s: float, work: Callable[[], None], clock: Clock | None = None) -> Timer:
        """Work by a timer while the node is active."""

        def guarded() -> None:
            self.settle()
            if self.is_active:
                work()

        return self.create_timer(period_s, guarded, clock=clock)

    def keep(self, state: Callable[[], State | None], resume: Callable[[State], None]) -> None:
        """Keep what a state returns, again and again, for the case that the node is killed.

        state: returns None where there is nothing to keep. resume: is called with what a
        predecessor left that was killed a short time ago. Where it raises a ThinmapError, as the
        node was started with other parameters, the node begins anew.
        """
        self._recovery = Recovery(self, self._recover_s)
        self._state_of = state
        self._kept_at = monotonic()
        self._keeping_s = 0.0
        self.create_timer(_KEEP_S, self._keep, clock=Clock(clock_type=ClockType.STEADY_TIME))
        left = self._recovery.left()
        if left is None:
            return
        try:
            resume(left)
        except ThinmapError as error:
            refused = f'what it had is refused: {one_line_reason(error)}'
            self.get_logger().warning(f'was killed, but {refused}: begins anew')
            self._forget()
        else:
            self.get_logger().warning('was killed, goes on from what it had; ~/reset begins anew')

    def close(self) -> None:
        """Leave nothing behind: the node ends in order."""
        if self._recovery is not None:
            self._recovery.forget()

    def keep_news(self) -> bool:
        """Keep the state before others hear what is new in it; returns whether there was time."""
        return self._keep(_LEAST_PAUSES_NEWS)

    def _keep(self, least_pauses: float = _LEAST_PAUSES) -> bool:
        # However large the map: keeping it takes a small share of the time.
        now = monotonic()
        if self._recovery is None or now - self._kept_at < least_pauses * self._keeping_s:
            return False
        state = self._state_of()
        if state is not None:
            self._recovery.keep(state)
        self._kept_at = monotonic()
        self._keeping_s = self._kept_at - now
        return True

    def when_activated(self, work: Callable[[], None]) -> None:
        """Have something done each time that the node becomes active."""
        self._on_activation.append(work)

    def settle(self) -> None:
        """Begin anew if the clock was set back: before anything of the new time is taken."""
        if self._set_back:
            self._set_back = False
            self.set_backs = self.set_backs + 1
            self.get_logger().warning('the clock was set back: beginning anew')
            self.health.dropped('begun anew: the clock was set back', 1)
            self._forget()

    def is_of_before(self, stamp_ns: int) -> bool:
        """Whether a stamp is one of the last before the clock was set back."""
        return abs(self._before_ns - stamp_ns) < self._back_ns // 4

    def _on_jump(self, jump: TimeJump) -> None:
        # Only noted: whoever sets the clock must not be kept waiting.
        self._set_back = True
        self._back_ns = -jump.delta.nanoseconds
        self._before_ns = self.get_clock().now().nanoseconds + self._back_ns

    def _forget(self) -> None:
        self.stand_still()
        if self._recovery is not None:
            self._recovery.forget()
        self.begin_anew()

    # States.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Be ready."""
        self.health.state(OK, 'inactive')
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take messages from now on."""
        self.is_active = True
        self.health.state(OK, 'running')
        for work in self._on_activation:
            work()
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take no messages, and leave nothing moving."""
        self.is_active = False
        self.stand_still()
        self.health.state(OK, 'inactive')
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget everything."""
        self._forget()
        self.health.state(OK, 'unconfigured')
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop for good; the process ends with its signal, as always."""
        self.is_active = False
        self.stand_still()
        self.health.state(OK, 'finalized')
        return super().on_shutdown(state)

    def _survive_wrong_transitions(self) -> None:
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

        return answer(response, work)

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.is_paused = request.data
        self.health.pause(self.is_paused)
        return answer(
            response, lambda: 'no new scans are taken' if self.is_paused else 'scans are taken'
        )
