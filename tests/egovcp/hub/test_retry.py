"""Requests are limited in time and number, and only while they should be."""

import os
import signal
import threading
from collections.abc import Callable
from typing import Any

import huggingface_hub
import pytest

from egovcp.hub import HubUnreachable, RetryPolicy, retrying
from egovcp.hub.retry import RetryingClient, http_library
from tests.support.hub import FakeHub, client_factory


def ask(hub: FakeHub, seconds: float | None) -> int:
    client = huggingface_hub.get_session()
    return client.get(f"{hub.endpoint}/api/whoami-v2", timeout=seconds).status_code


def in_fork(function: Callable[[], int]) -> int:
    """What the function returns in a forked child; it is killed after 20 s."""
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        os._exit(function())
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_a_request_is_repeated_unless_it_is_optional(hub: FakeHub, quick: RetryPolicy) -> None:
    hub.fail("whoami", 503)
    with retrying(quick):
        with pytest.raises(HubUnreachable, match=r"503 .* to GET .*/api/whoami-v2, 2 times"):
            ask(hub, None)
        assert hub.requests["whoami"] == 2
        assert ask(hub, 3) == 503
    assert hub.requests["whoami"] == 3


def test_the_client_of_a_users_factory_sends_the_requests(hub: FakeHub, quick: RetryPolicy) -> None:
    http, made = http_library(), []

    def factory() -> Any:
        made.append(http.Client(headers={"x-proxy": "mine"}))
        return made[-1]

    hub.fail("whoami", 503)
    with client_factory(factory):
        with retrying(quick), pytest.raises(HubUnreachable, match="2 times"):
            ask(hub, None)
        assert huggingface_hub.get_session() is made[0]
        assert hub.requests["whoami"] == 2
        assert ask(hub, None) == 503
        assert hub.requests["whoami"] == 3


def test_connections_stay_open_between_blocks(hub: FakeHub, quick: RetryPolicy) -> None:
    client, sessions = RetryingClient(quick), []
    for _ in range(2):
        with client.open():
            assert ask(hub, None) == 200
            sessions.append(huggingface_hub.get_session())
    assert sessions[0] is sessions[1]
    assert not sessions[0].is_closed


def test_a_refused_connection_is_repeated(
    hub: FakeHub, quick: RetryPolicy, caplog: pytest.LogCaptureFixture
) -> None:
    with retrying(quick), pytest.raises(HubUnreachable, match=r"ConnectError .*, 2 times"):
        huggingface_hub.get_session().get("http://127.0.0.1:9/")
    assert "trying again" in caplog.text


def test_a_fork_inside_a_block_does_not_lock_the_child(hub: FakeHub, quick: RetryPolicy) -> None:
    client = RetryingClient(quick)
    hub.fail("whoami", 503)

    def child() -> int:
        with client.open(), pytest.raises(HubUnreachable, match="2 times"):
            ask(hub, None)
        with retrying(quick):  # another policy than that of the parent's block
            return 7

    with client.open():
        assert in_fork(child) == 7
    with retrying(quick):
        pass


def test_threads_share_a_client_and_others_wait(hub: FakeHub, quick: RetryPolicy) -> None:
    client, alone = RetryingClient(quick), threading.Event()

    def other() -> None:
        with retrying(quick):
            alone.set()

    waiting = threading.Thread(target=other, daemon=True)
    with client.open():
        with client.open():
            waiting.start()
            assert ask(hub, None) == 200
        assert not alone.wait(0.2)
        assert ask(hub, None) == 200
    assert alone.wait(20)
    waiting.join(20)


def test_the_next_request_starts_with_all_attempts(hub: FakeHub, quick: RetryPolicy) -> None:
    client = RetryingClient(quick)
    hub.fail("whoami", 503)
    for asked in (2, 4):
        with client.open(), pytest.raises(HubUnreachable, match="2 times"):
            ask(hub, None)
        assert hub.requests["whoami"] == asked
