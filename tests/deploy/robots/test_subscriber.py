"""Subscriptions under load, and statistics of arrivals."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
import zmq

from egovcp_deploy.robots.subscriber import _QUEUE, ArrivalMonitor, Subscriber
from egovcp_deploy.robots.wire import MalformedMessage
from tests.support.robots.fake_g1 import eventually


@pytest.fixture
def publisher() -> Iterator[zmq.Socket[bytes]]:
    with zmq.Context() as context, context.socket(zmq.PUB) as end:
        end.setsockopt(zmq.LINGER, 0)
        end.bind("tcp://127.0.0.1:*")
        yield end


@pytest.fixture
def listen(publisher: zmq.Socket[bytes]) -> Iterator[Callable[..., Subscriber]]:
    listeners: list[Subscriber] = []

    def make(
        take: Callable[[bytes, int, int], bool],
        reject: Callable[[str, int], None] = lambda problem, time_ns: None,
    ) -> Subscriber:
        port = int(publisher.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        listeners.append(Subscriber("127.0.0.1", port, 100_000, take, reject))
        return listeners[-1]

    yield make
    for listener in listeners:
        listener.close()


def test_newest_usable_message_is_taken(
    listen: Callable[..., Subscriber],
) -> None:
    tried: list[tuple[bytes, int]] = []

    def take(message: bytes, time_ns: int, older: int) -> bool:
        tried.append((message, older))
        return message.startswith(b"good")

    assert listen(take)._handle_newest([b"good 1", b"bad", b"good 2", b"bad", b"bad"])
    assert tried == [(b"bad", 4), (b"bad", 3), (b"good 2", 2)]


def test_no_message_ends_the_thread(
    publisher: zmq.Socket[bytes], listen: Callable[..., Subscriber]
) -> None:
    heard: list[bytes] = []
    rejected: list[str] = []

    def take(message: bytes, time_ns: int, older: int) -> bool:
        if message == b"short":
            raise MalformedMessage("too short")
        if message == b"bug":
            raise KeyError("q")
        heard.append(message)
        return True

    listener = listen(take, lambda problem, time_ns: rejected.append(problem))
    assert listener._handle_newest([b"good", b"short", b"bug"])
    assert heard == [b"good"]
    assert rejected[0].startswith(f"KeyError('q') in {__file__}:")
    assert rejected[1:] == ["too short"]

    def received() -> bool:
        for message in (b"bug", b"good", b"bug"):
            publisher.send(message)
        return len(heard) > 3 and len(rejected) > 5

    assert eventually(received)


def test_processing_time_of_a_flood_is_bounded(listen: Callable[..., Subscriber]) -> None:
    tried: list[bytes] = []

    def slow(message: bytes, time_ns: int, older: int) -> bool:
        tried.append(message)
        time.sleep(0.0015)
        return False

    assert not listen(slow)._handle_newest([b"bad"] * 100)
    assert 1 <= len(tried) <= 2


def test_messages_of_a_full_queue_are_dropped(listen: Callable[..., Subscriber]) -> None:
    """What waits in it may be older than it seems."""
    tried: list[bytes] = []
    listener = listen(lambda message, time_ns, older: bool(tried.append(message)) or True)
    assert not listener._handle_newest([b"good"] * _QUEUE)
    assert not tried


def test_usable_messages_are_received_during_a_flood(
    publisher: zmq.Socket[bytes], listen: Callable[..., Subscriber]
) -> None:
    heard: list[bytes] = []

    def take(message: bytes, time_ns: int, older: int) -> bool:
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


def test_a_flood_uses_little_processor_time(
    publisher: zmq.Socket[bytes], listen: Callable[..., Subscriber]
) -> None:
    """The interpreter's lock must be free for the control loop."""
    busy = [0.0]

    def take(message: bytes, time_ns: int, older: int) -> bool:
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


MS = 1_000_000


def filled(times_ms: list[float], estimate_losses: bool = True) -> ArrivalMonitor:
    arrivals = ArrivalMonitor(estimate_losses)
    for time_ms in times_ms:
        arrivals.record_arrival(round(time_ms * MS))
    return arrivals


def test_stats_of_a_steady_stream() -> None:
    stats = filled([5.0 * k for k in range(1, 401)]).stats(2000 * MS)
    assert stats.rate_hz == pytest.approx(200.0)
    assert (stats.jitter_ms, stats.gap_ms, stats.lost) == (0.0, 5.0, 0.0)


def test_stats_use_only_the_window() -> None:
    arrivals = filled([5.0 * k for k in range(1, 201)])
    arrivals.record_loss(1 * MS, 500)
    assert arrivals.stats(2500 * MS).lost == 1.0, "nothing in the last second"
    assert arrivals.stats(2500 * MS).gap_ms == 1000.0
    assert arrivals.stats(2000 * MS, window_s=1.5).lost == 0.0


def test_silence_counts_as_a_gap() -> None:
    assert filled([5.0 * k for k in range(1, 101)]).stats(700 * MS).gap_ms == 200.0


def test_missing_messages_are_estimated_from_intervals() -> None:
    times = [5.0 * k for k in range(1, 201) if k % 10]  # every tenth is missing
    assert filled(times).stats(1000 * MS).lost == pytest.approx(0.1, abs=0.01)


def test_unusable_messages_are_counted_once() -> None:
    arrivals = filled([5.0 * k for k in range(1, 201) if k % 10])
    for k in range(10, 201, 10):
        arrivals.record_loss(round(5.0 * k * MS))
    assert arrivals.stats(1000 * MS).lost == pytest.approx(0.1, abs=0.01)


def test_losses_are_not_estimated_if_the_caller_reports_them() -> None:
    arrivals = filled([5.0 * k for k in range(1, 201) if k % 10], estimate_losses=False)
    assert arrivals.stats(1000 * MS).lost == 0.0
    arrivals.record_loss(900 * MS, 20)
    assert arrivals.stats(1000 * MS).lost == pytest.approx(20 / 200)


def test_jitter_is_the_deviation_from_the_median_interval() -> None:
    times = [5.0 * k + (1.0 if k % 2 else 0.0) for k in range(1, 201)]
    assert filled(times).stats(1000 * MS).jitter_ms == pytest.approx(2.0)
