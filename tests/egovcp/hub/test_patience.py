"""Requests are limited in time and number, and only while they should be."""

import threading

import httpx
import huggingface_hub
import pytest

from egovcp.hub import HubUnreachable, Patience, patient
from egovcp.hub.patience import Line
from egovcp.testing.hub import FakeHub


def ask(hub: FakeHub, seconds: float | None) -> int:
    client = huggingface_hub.get_session()
    return client.get(f"{hub.endpoint}/api/whoami-v2", timeout=seconds).status_code


def test_a_request_is_repeated_unless_it_can_be_done_without(hub: FakeHub, quick: Patience) -> None:
    hub.fail("whoami", 503)
    with patient(quick):
        with pytest.raises(HubUnreachable, match=r"503 .* to GET .*/api/whoami-v2, 2 times"):
            ask(hub, None)
        assert hub.requests["whoami"] == 2
        assert ask(hub, 3) == 503
    assert hub.requests["whoami"] == 3


def test_the_users_own_client_is_used_and_given_back(hub: FakeHub, quick: Patience) -> None:
    made: list[httpx.Client] = []

    def factory() -> httpx.Client:
        made.append(httpx.Client(headers={"x-proxy": "mine"}))
        return made[-1]

    before = huggingface_hub.utils._http._GLOBAL_CLIENT_FACTORY
    huggingface_hub.set_client_factory(factory)
    try:
        with patient(quick):
            assert huggingface_hub.get_session() is made[0]
        hub.fail("whoami", 503)
        assert ask(hub, None) == 503
        assert hub.requests["whoami"] == 1
    finally:
        huggingface_hub.set_client_factory(before)


def test_a_line_keeps_its_client_until_it_is_closed(hub: FakeHub, quick: Patience) -> None:
    line, clients = Line(quick), []
    before = huggingface_hub.utils._http._GLOBAL_CLIENT_FACTORY
    for _ in range(2):
        with line.open():
            assert ask(hub, None) == 200
            clients.append(huggingface_hub.get_session())
        assert huggingface_hub.utils._http._GLOBAL_CLIENT_FACTORY is before
        assert huggingface_hub.get_session() is not clients[0]
    assert clients[0] is clients[1]
    line.close()
    assert clients[0].is_closed
    with line.open():
        assert ask(hub, None) == 200
    line.close()


def test_threads_share_a_line_and_others_wait(hub: FakeHub, quick: Patience) -> None:
    line, alone = Line(quick), threading.Event()

    def other() -> None:
        with patient(quick):
            alone.set()

    waiting = threading.Thread(target=other, daemon=True)
    with line.open():
        with line.open():
            waiting.start()
            assert ask(hub, None) == 200
        assert not alone.wait(0.2)
        assert ask(hub, None) == 200
    assert alone.wait(20)
    waiting.join(20)
    line.close()


def test_whoever_asks_anew_has_all_tries_again(hub: FakeHub, quick: Patience) -> None:
    line = Line(quick)
    hub.fail("whoami", 503)
    for asked in (2, 4):
        with line.open(), pytest.raises(HubUnreachable, match="2 times"):
            ask(hub, None)
        assert hub.requests["whoami"] == asked
    line.close()
