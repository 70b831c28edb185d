"""What a listener does with many messages at once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
import zmq

from egovcp_deploy.robots.fake.running import eventually
from egovcp_deploy.robots.listener import _QUEUE, Listener


@pytest.fixture
def publisher() -> Iterator[zmq.Socket[bytes]]:
    with zmq.Context() as context, context.socket(zmq.PUB) as end:
        end.setsockopt(zmq.LINGER, 0)
        end.bind("tcp://127.0.0.1:*")
        yield end


@pytest.fixture
def listen(publisher: zmq.Socket[bytes]) -> Iterator[Callable[..., Listener]]:
    listeners: list[Listener] = []

    def make(take: Callable[[bytes, int], bool]) -> Listener:
        port = int(publisher.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        listeners.append(Listener("127.0.0.1", port, 100_000, take))
        return listeners[-1]

    yield make
    for listener in listeners:
        listener.close()


def test_the_newest_usable_message_is_found_among_garbage(listen: Callable[..., Listener]) -> None:
    tried: list[bytes] = []

    def take(message: bytes, time_ns: int) -> bool:
        tried.append(message)
        return message.startswith(b"good")

    listener = listen(take)
    assert listener._take_newest([b"good 1", b"bad", b"good 2", b"bad", b"bad"])
    assert tried == [b"bad", b"bad", b"good 2"]


def test_the_work_on_a_flood_is_bounded(listen: Callable[..., Listener]) -> None:
    tried: list[bytes] = []

    def slow(message: bytes, time_ns: int) -> bool:
        tried.append(message)
        time.sleep(0.0015)
        return False

    assert not listen(slow)._take_newest([b"bad"] * 100)
    assert 1 <= len(tried) <= 2


def test_a_full_queue_is_not_believed(listen: Callable[..., Listener]) -> None:
    """What waits in it may be older than it seems."""
    tried: list[bytes] = []
    listener = listen(lambda message, time_ns: bool(tried.append(message)) or True)
    assert not listener._take_newest([b"good"] * _QUEUE)
    assert not tried


def test_a_state_is_heard_through_a_flood(
    publisher: zmq.Socket[bytes], listen: Callable[..., Listener]
) -> None:
    heard: list[bytes] = []

    def take(message: bytes, time_ns: int) -> bool:
        if message.startswith(b"good"):
            heard.append(message)
        return message.startswith(b"good")

    listen(take)
    count = iter(range(1_000_000))

    def flooded() -> bool:
        publisher.send(b"good %d" % next(count))
        for _ in range(20):
            publisher.send(b"x" * 2000)
        return len(heard) >= 10

    assert eventually(flooded)


def test_a_flood_costs_little_processor_time(
    publisher: zmq.Socket[bytes], listen: Callable[..., Listener]
) -> None:
    """The interpreter's lock must be free for the control loop."""
    busy = [0.0]

    def take(message: bytes, time_ns: int) -> bool:
        begin = time.thread_time()
        while time.thread_time() - begin < 0.0005:
            pass
        busy[0] += 0.0005
        return False

    listen(take)
    begin = time.monotonic()
    while time.monotonic() - begin < 1.0:
        for _ in range(40):
            publisher.send(b"x" * 2000)
        time.sleep(0.01)
    assert 0.0 < busy[0] < 0.25
