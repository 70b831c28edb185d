"""Requests are limited in time and number, and only while they should be."""

import os
import signal
import threading
from collections.abc import Callable
from typing import Any

import huggingface_hub
import pytest

from egovcp.hub import HubUnreachable, RetryPolicy, retrying
from egovcp.hub.retry import http_library
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
    sessions = []
    for _ in range(2):
        with retrying(quick):
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
    hub.fail("whoami", 503)

    def child() -> int:
        with retrying(quick), pytest.raises(HubUnreachable, match="2 times"):
            ask(hub, None)
        return 7

    with retrying(RetryPolicy(attempts=1)):  # another policy than that of the child
        assert in_fork(child) == 7
    with retrying(quick), pytest.raises(HubUnreachable, match="2 times"):
        ask(hub, None)


def test_the_policy_of_the_oldest_open_block_applies_to_all_threads(
    hub: FakeHub, quick: RetryPolicy
) -> None:
    hub.fail("whoami", 503)
    opened, close = threading.Event(), threading.Event()

    def other() -> None:
        with retrying(RetryPolicy(attempts=1)):
            opened.set()
            close.wait(20)

    thread = threading.Thread(target=other, daemon=True)
    with retrying(quick):
        thread.start()
        assert opened.wait(20)
        with pytest.raises(HubUnreachable, match="2 times"):
            ask(hub, None)
    with pytest.raises(HubUnreachable):
        ask(hub, None)
    assert hub.requests["whoami"] == 3
    close.set()
    thread.join(20)
    assert ask(hub, None) == 503


def test_the_next_request_starts_with_all_attempts(hub: FakeHub, quick: RetryPolicy) -> None:
    hub.fail("whoami", 503)
    for asked in (2, 4):
        with retrying(quick), pytest.raises(HubUnreachable, match="2 times"):
            ask(hub, None)
        assert hub.requests["whoami"] == asked
