"""The executor of nodes: the order of rclpy's, and entities that come and go."""

import threading
from functools import partial

import pytest
import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger

from thinmap_ros.ros.executor import NodeExecutor

TRIES = 1000


@pytest.fixture
def node(ros_domain):
    rclpy.init(args=[])
    made = rclpy.create_node('some')
    yield made
    made.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def executor(node):
    made = NodeExecutor(node)
    yield made
    made.shutdown()


def step_of_rclpy(executor):
    task, _, _ = executor.wait_for_ready_callbacks(timeout_sec=1.0)
    task()


def step(executor):
    ready = executor.next_callback(timeout_s=1.0)
    if ready is not None:
        ready.call()


def until(condition, executor, one_step=step):
    for _ in range(TRIES):
        if condition():
            return
        one_step(executor)
    pytest.fail('never')


class Calls:
    """A node's callbacks of all kinds, which write down their names."""

    def __init__(self, node):
        self.names = []
        self.node = node
        for topic in ('a', 'b'):
            node.create_subscription(String, topic, self.named(topic), 10)
        self.publishers = [node.create_publisher(String, topic, 10) for topic in ('b', 'a')]
        node.create_service(Trigger, 'ask', self.answer)
        self.client = node.create_client(Trigger, 'ask')
        self.bell = node.create_guard_condition(lambda: self.names.append('bell'))

    def named(self, name):
        return lambda message: self.names.append(name + message.data)

    def answer(self, request, response):
        self.names.append('asked')
        return response

    def make_ready(self):
        for number in range(3):
            for publisher in self.publishers:
                publisher.publish(String(data=str(number)))
        self.client.call_async(Trigger.Request()).add_done_callback(
            lambda future: self.names.append('answered')
        )
        self.bell.trigger()
        timer = self.node.create_timer(1e-6, lambda: (self.names.append('timer'), timer.cancel()))

    def called(self, executor, one_step):
        self.names.clear()
        until(lambda: self.client.service_is_ready(), executor, one_step)
        self.make_ready()
        until(lambda: len(self.names) == 10, executor, one_step)
        return list(self.names)


def test_callbacks_come_in_the_order_of_rclpys_executor(node):
    calls = Calls(node)
    of_rclpy = SingleThreadedExecutor()
    of_rclpy.add_node(node)
    expected = calls.called(of_rclpy, step_of_rclpy)
    of_rclpy.shutdown()
    own = NodeExecutor(node)
    assert calls.called(own, step) == expected
    own.shutdown()


def test_it_waits_with_one_wait_set_as_long_as_the_entities_are_the_same(node, executor):
    Calls(node)
    seen = []
    timer = node.create_timer(1e-3, lambda: seen.append(executor._wait_set))
    until(lambda: len(seen) == 20, executor)
    assert len(set(map(id, seen))) == 1
    node.create_timer(1e3, print)
    until(lambda: len(seen) == 22, executor)
    assert seen[-1] is not seen[0]
    timer.cancel()


def test_entities_come_and_go_while_callbacks_run(node, executor):
    heard = set()
    publisher = node.create_publisher(String, 'a', 10)
    made = []

    def replace():
        # Only what has heard: on a busy machine the timer is due at once, before the message.
        if len(heard) == len(made):
            if made:
                node.destroy_subscription(made[-1])
            hear = partial(heard.add, len(made))
            made.append(node.create_subscription(String, 'a', lambda _: hear(), 10))
        publisher.publish(String())

    timer = node.create_timer(1e-3, replace)
    until(lambda: len(heard) >= 5, executor)
    timer.cancel()
    node.destroy_timer(timer)
    node.destroy_subscription(made[-1])
    heard.clear()
    publisher.publish(String())
    assert executor.next_callback(timeout_s=0.1) is None
    assert not heard


def test_a_topic_may_come_back_with_another_type(node, executor):
    heard = []
    subscriptions = [node.create_subscription(String, 'a', heard.append, 10)]

    def replace():
        node.destroy_subscription(subscriptions.pop())
        subscriptions.append(node.create_subscription(Bool, 'a', heard.append, 10))
        timer.cancel()

    timer = node.create_timer(1e-3, replace)
    until(timer.is_canceled, executor)
    publisher = node.create_publisher(Bool, 'a', 10)
    until(lambda: publisher.get_subscription_count() == 1, executor)
    publisher.publish(Bool())
    until(lambda: heard, executor)
    assert heard == [Bool()]


def test_a_subscription_that_another_callback_destroys_is_not_called(node, executor):
    heard = []
    subscriptions = []

    def hear(name):
        heard.append(name)
        for each in subscriptions:
            node.destroy_subscription(each)
        subscriptions.clear()

    for name in ('first', 'second'):
        subscriptions.append(
            node.create_subscription(String, 'a', lambda _, name=name: hear(name), 10)
        )
    publisher = node.create_publisher(String, 'a', 10)
    until(lambda: publisher.get_subscription_count() == 2, executor)
    publisher.publish(String())
    until(lambda: heard, executor)
    for _ in range(5):
        executor.next_callback(timeout_s=0.02)
    assert heard == ['first']


def test_a_coroutine_answers_once_its_future_is_done(node, executor):
    future = Future()
    answers = []

    async def answer(request, response):
        response.message = await future
        return response

    node.create_service(Trigger, 'ask', answer)
    client = node.create_client(Trigger, 'ask')
    until(client.service_is_ready, executor)
    client.call_async(Trigger.Request()).add_done_callback(lambda done: answers.append(done))
    for _ in range(20):
        ready = executor.next_callback(timeout_s=0.01)
        if ready is not None:
            ready.call()
    assert not answers
    future.set_result('late')
    until(lambda: answers, executor)
    assert answers[0].result().message == 'late'


def test_what_a_callback_raises_is_raised_with_its_entity(node, executor):
    def fail(message):
        raise ZeroDivisionError

    node.create_subscription(String, 'a', fail, 10)
    publisher = node.create_publisher(String, 'a', 10)
    until(lambda: publisher.get_subscription_count() == 1, executor)
    publisher.publish(String())
    ready = next(filter(None, (executor.next_callback(1.0) for _ in range(TRIES))))
    assert ready.entity.topic_name == '/a'
    with pytest.raises(ZeroDivisionError):
        ready.call()


def test_another_thread_wakes_it(node, executor):
    rung = []
    bell = node.create_guard_condition(lambda: rung.append(threading.get_ident()))
    thread = threading.Thread(target=bell.trigger)
    thread.start()
    until(lambda: rung, executor)
    thread.join()
    assert rung == [threading.get_ident()]


def test_events_of_qos_come_and_are_not_waited_for_with_each_message(node, executor, monkeypatch):
    monkeypatch.setattr('thinmap_ros.ros.executor.monotonic', lambda: 0.0)
    heard = []
    told = []
    added = []
    events = SubscriptionEventCallbacks(incompatible_qos=told.append)
    subscription = node.create_subscription(String, 'a', heard.append, 10, event_callbacks=events)
    publisher = node.create_publisher(String, 'a', 10)
    until(lambda: publisher.get_subscription_count() == 1, executor)
    handler = next(each for each in subscription.event_handlers if each.callback == told.append)
    add = handler.add_to_wait_set
    monkeypatch.setattr(handler, 'add_to_wait_set', lambda it: (added.append(it), add(it)))
    for number in range(10):
        publisher.publish(String(data=str(number)))
    until(lambda: len(heard) == 10, executor)
    assert len(added) < 5
    lesser = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_publisher(String, 'a', lesser)
    until(lambda: told, executor)
    assert told[0].total_count == 1


def test_a_cancelled_timer_is_not_waited_for_and_one_that_is_reset_is_called(node, executor):
    called = []
    timer = node.create_timer(1e-3, lambda: called.append(1))
    until(lambda: called, executor)
    timer.cancel()
    waited = []
    handle = executor._wait_set

    class Recorded:
        def add_timer(self, each):
            waited.append(each)

        def __getattr__(self, name):
            return getattr(handle, name)

    executor._wait_set = Recorded()
    executor._fill()
    assert timer.handle not in waited
    timer.reset()
    executor._fill()
    assert timer.handle in waited
    executor._wait_set = handle
    called.clear()
    until(lambda: called, executor)


def test_it_ends_once_ros_is_shut_down(node, executor):
    rclpy.shutdown()
    with pytest.raises(ExternalShutdownException):
        executor.next_callback(timeout_s=1.0)
