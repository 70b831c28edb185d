"""Errors say what to do, and never the token."""

import errno
import ssl
from pathlib import Path

import pytest
from huggingface_hub import constants

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.hub import HubUnreachable, Publication, RetryPolicy, hub_errors, hub_token, publish
from tests.support.hub import FakeHub


@pytest.mark.parametrize("bad", ["hf_abc\x01def", "hf_abc def", "hf_abć"])
def test_an_invalid_token_is_refused_and_not_shown(
    monkeypatch: pytest.MonkeyPatch, bad: str
) -> None:
    monkeypatch.setenv("HF_TOKEN", bad)
    with pytest.raises(UsageError, match="hf auth login") as caught:
        hub_token()
    assert "hf_" not in str(caught.value)


def test_a_token_that_the_server_echoes_is_hidden(
    hub: FakeHub, publication: Publication, quick: RetryPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    hub.fail("create", 418, message="who are you, hf_secret?")
    with pytest.raises(EnvironmentFailure, match="who are you, <token>") as caught:
        publish(publication, quick)
    assert "try again" not in str(caught.value)  # it would be refused again


def test_a_missing_file_is_not_a_network_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), hub_errors("me/small"):
        (tmp_path / "none").read_bytes()


def test_a_full_disk_is_not_a_network_error() -> None:
    with pytest.raises(OSError, match="No space left") as caught, hub_errors("me/small"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.errno == errno.ENOSPC


def test_missing_certificates_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", "/nonexistent")
    with pytest.raises(EnvironmentFailure, match="SSL_CERT_FILE=/nonexistent"):  # noqa: SIM117
        with hub_errors("me/small"):
            ssl.create_default_context(cafile="/nonexistent")


def test_an_upload_of_an_unreadable_file_is_not_a_network_error() -> None:
    with pytest.raises(EnvironmentFailure) as caught, hub_errors("me/small"):
        raise RuntimeError("Error while uploading") from OSError(errno.EIO, "cannot read")
    assert not isinstance(caught.value, HubUnreachable)


def test_offline_mode_sends_no_request(
    hub: FakeHub, publication: Publication, quick: RetryPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(EnvironmentFailure, match="HF_HUB_OFFLINE is set"):
        publish(publication, quick)
    assert not hub.requests
