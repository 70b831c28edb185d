"""Errors say what to do, and never the token."""

import errno
from pathlib import Path

import pytest
from huggingface_hub import constants

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.hub import Publication, RetryPolicy, explained, publish, token
from tests.support.hub import FakeHub


@pytest.mark.parametrize("bad", ["hf_abc\x01def", "hf_abc def", "hf_abć"])
def test_a_token_that_is_none_is_refused_unseen(monkeypatch: pytest.MonkeyPatch, bad: str) -> None:
    monkeypatch.setenv("HF_TOKEN", bad)
    with pytest.raises(UsageError, match="hf auth login") as caught:
        token()
    assert "hf_" not in str(caught.value)


def test_a_token_that_the_server_echoes_is_hidden(
    hub: FakeHub, publication: Publication, quick: RetryPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    hub.fail("create", 418, message="who are you, hf_secret?")
    with pytest.raises(EnvironmentFailure, match="who are you, <token>"):
        publish(publication, quick)


def test_the_disk_is_not_the_network(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), explained("me/small"):
        (tmp_path / "none").read_bytes()


def test_a_full_disk_is_not_the_network() -> None:
    with pytest.raises(OSError, match="No space left") as caught, explained("me/small"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.errno == errno.ENOSPC


def test_offline_means_offline(
    hub: FakeHub, publication: Publication, quick: RetryPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(EnvironmentFailure, match="HF_HUB_OFFLINE is set"):
        publish(publication, quick)
    assert not hub.requests
