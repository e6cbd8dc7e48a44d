"""`ros2 action send_goal`."""

import sys
from argparse import Namespace
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.task import Future

from ros2_shim import values
from ros2_shim.session import Session
from ros2_shim.verb import ShimError, Verb, argument, flag, say

_STATUS = {
    GoalStatus.STATUS_ACCEPTED: 'ACCEPTED',
    GoalStatus.STATUS_EXECUTING: 'EXECUTING',
    GoalStatus.STATUS_CANCELING: 'CANCELING',
    GoalStatus.STATUS_SUCCEEDED: 'SUCCEEDED',
    GoalStatus.STATUS_CANCELED: 'CANCELED',
    GoalStatus.STATUS_ABORTED: 'ABORTED',
}
_CANCEL_S = 10.0


def _send_goal(args: Namespace) -> None:
    kind = values.type_named(args.action_type, 'action')
    goal = values.read(kind.Goal, args.goal)
    with Session(args) as session:
        name = session.full_name(args.action_name, 'action')
        client = ActionClient(session.node, kind, name)
        say('Waiting for an action server to become available...')
        session.until(client.server_is_ready)
        session.introduce(session.server_of(f'{name}/_action/send_goal'))
        say(f'Sending goal:\n     {values.to_yaml(goal)}')
        feedback = _Feedback()
        sent = client.send_goal_async(goal, feedback.hear if args.feedback else None)
        try:
            _follow(session, sent, feedback)
        except (KeyboardInterrupt, BrokenPipeError):
            _cancel(session, sent)
            raise
        finally:
            client.destroy()


class _Feedback:
    """Shows feedback, but not before the acceptance of the goal.

    Acceptance and feedback arrive on separate channels, in any order.
    """

    def __init__(self) -> None:
        self._held: list[Any] | None = []

    def hear(self, message: Any) -> None:
        """Show a feedback message, or queue it."""
        if self._held is None:
            say(f'Feedback:\n    {values.to_yaml(message.feedback)}')
        else:
            self._held.append(message)

    def release(self) -> None:
        """Show queued messages, and later ones at once."""
        held = self._held or []
        self._held = None
        for message in held:
            self.hear(message)


def _follow(session: Session, sent: Future, feedback: _Feedback) -> None:
    """Show the progress of a goal until it ends."""
    handle = session.result(sent)
    if not handle.accepted:
        say('Goal was rejected.')
        return
    say(f'Goal accepted with ID: {bytes(handle.goal_id.uuid).hex()}\n')
    feedback.release()
    ended = session.result(handle.get_result_async())
    say(f'Result:\n    {values.to_yaml(ended.result)}')
    say(f'Goal finished with status: {_STATUS.get(ended.status, "UNKNOWN")}')


def _cancel(session: Session, sent: Future) -> None:
    """Cancel a goal, also one whose acceptance is not known yet.

    Reports on standard error if the output is a closed pipe: the robot stops all the same.
    """
    if not session.until(sent.done, _CANCEL_S):
        raise ShimError('Failed to cancel goal: no answer whether it was accepted')
    handle = sent.result()
    if handle is None or not handle.accepted:
        return
    if handle.status not in (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING):
        return
    _say_somewhere('Canceling goal...')
    answer = handle.cancel_goal_async()
    if not session.until(answer.done, _CANCEL_S) or not answer.result().goals_canceling:
        raise ShimError('Failed to cancel goal')
    _say_somewhere('Goal canceled.')


def _say_somewhere(text: str) -> None:
    try:
        say(text)
    except BrokenPipeError:
        print(text, file=sys.stderr)


VERBS = {
    'send_goal': Verb(
        'Send a goal and wait for its end; Ctrl-C cancels it.',
        _send_goal,
        (
            argument('action_name'),
            argument('action_type', help='as in thinmap_msgs/action/Explore'),
            argument('goal', nargs='?', default='{}', help="as in '{time_limit_s: 60.0}'"),
            flag('-f --feedback', 'show the feedback'),
        ),
    ),
}
