"""Requests are limited in time and number, and only while they should be."""

import httpx
import huggingface_hub
import pytest

from egovcp.hub import HubUnreachable, Patience, patient
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
