"""Calls are limited in time and number, and only while they should be."""

import os
import signal
from collections.abc import Callable
from typing import Any

import huggingface_hub
import pytest

from egovcp.hub import HubUnreachable, RetryPolicy, call_hub
from egovcp.hub.errors import http_library
from tests.support.hub import FakeHub, client_factory


def ask(hub: FakeHub, seconds: float | None) -> int:
    client = huggingface_hub.get_session()
    return client.get(f"{hub.endpoint}/api/whoami-v2", timeout=seconds).status_code


def call(hub: FakeHub, retry: RetryPolicy, seconds: float | None = None) -> int:
    return call_hub(lambda: ask(hub, seconds), retry, "me/small")


def in_fork(function: Callable[[], int]) -> int:
    """What the function returns in a forked child; it is killed after 20 s."""
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        os._exit(function())
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_a_call_is_repeated_unless_the_request_is_optional(
    hub: FakeHub, quick: RetryPolicy
) -> None:
    hub.fail("whoami", 503)
    with pytest.raises(HubUnreachable, match=r"503 .* to GET .*/api/whoami-v2"):
        call(hub, quick)
    assert hub.requests["whoami"] == 2
    assert call(hub, quick, seconds=3) == 503
    assert hub.requests["whoami"] == 3


def test_the_client_of_a_users_factory_sends_the_requests(hub: FakeHub, quick: RetryPolicy) -> None:
    http, made = http_library(), []

    def factory() -> Any:
        made.append(http.Client(headers={"x-proxy": "mine"}))
        return made[-1]

    hub.fail("whoami", 503)
    with client_factory(factory):
        with pytest.raises(HubUnreachable):
            call(hub, quick)
        assert huggingface_hub.get_session() is made[0]
        assert hub.requests["whoami"] == 2
        assert ask(hub, None) == 503
        assert hub.requests["whoami"] == 3


def test_connections_stay_open_between_calls(hub: FakeHub, quick: RetryPolicy) -> None:
    sessions = []
    for _ in range(2):
        assert call(hub, quick) == 200
        sessions.append(huggingface_hub.get_session())
    assert sessions[0] is sessions[1]
    assert not sessions[0].is_closed


def test_a_refused_connection_is_repeated(
    hub: FakeHub, quick: RetryPolicy, caplog: pytest.LogCaptureFixture
) -> None:
    def refused() -> None:
        huggingface_hub.get_session().get("http://127.0.0.1:9/")

    with pytest.raises(HubUnreachable, match="ConnectError"):
        call_hub(refused, quick, "me/small")
    assert "trying again" in caplog.text


@pytest.mark.parametrize("error", [ConnectionError, TimeoutError, RuntimeError])
def test_a_failed_transfer_by_hf_xet_is_repeated(
    hub: FakeHub, quick: RetryPolicy, error: type[Exception]
) -> None:
    failures = iter([error("CAS Client Error: error sending request")])

    def transfer() -> str:
        for failure in failures:
            raise failure
        return "the file"

    assert call_hub(transfer, quick, "me/small") == "the file"


def test_a_call_in_a_forked_child_of_a_call_is_repeated(hub: FakeHub, quick: RetryPolicy) -> None:
    hub.fail("whoami", 503)

    def child() -> int:
        with pytest.raises(HubUnreachable):
            call(hub, quick)
        return 7

    assert call_hub(lambda: in_fork(child), quick, "me/small") == 7
    assert hub.requests["whoami"] == 2
