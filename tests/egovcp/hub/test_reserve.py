"""A repository is reserved before the work that is to fill it."""

from dataclasses import replace
from pathlib import Path

import pytest

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.hub import Content, Publication, RetryPolicy, publish, reserve
from tests.support.hub import FakeHub, in_this_process

POLICY = Publication("me/policy", {"config.json": Content(b"{}")}, "a policy", repo_type="model")


@pytest.fixture
def logged_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_right")


def test_nobody_is_logged_in(
    hub: FakeHub, quick: RetryPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HF_TOKEN", raising=False)
    with pytest.raises(EnvironmentFailure, match=r"nobody is logged in.*hf auth login"):
        reserve(POLICY, quick)
    assert not hub.requests


@pytest.mark.usefixtures("logged_in")
def test_a_token_without_the_right_is_refused(tmp_path: Path, quick: RetryPolicy) -> None:
    with (
        FakeHub(tmp_path / "hub", token="hf_other") as hub,
        in_this_process(hub.endpoint, tmp_path / "home"),
        pytest.raises(EnvironmentFailure, match="write access to models of me"),
    ):
        reserve(POLICY, quick)


@pytest.mark.usefixtures("logged_in")
def test_a_public_repository_is_not_taken_for_a_private_one(
    hub: FakeHub, quick: RetryPolicy
) -> None:
    reserve(POLICY, quick)
    with pytest.raises(UsageError, match="is public, --private was given"):
        reserve(replace(POLICY, private=True), quick)


@pytest.mark.usefixtures("logged_in")
@pytest.mark.parametrize("private", [False, True])
def test_what_is_reserved_is_empty_and_is_filled_later(
    hub: FakeHub, quick: RetryPolicy, private: bool
) -> None:
    policy = replace(POLICY, private=private)
    reserve(policy, quick)
    reserve(policy, quick)
    assert "config.json" not in hub.store.commit("models/me/policy", "main").files
    assert hub.store.refs("models/me/policy").private == private
    commit = publish(policy, quick).commit
    assert hub.store.commit("models/me/policy", "main").sha == commit
    assert "config.json" in hub.store.commit("models/me/policy", "main").files


def test_a_model_and_a_dataset_of_one_name_are_apart(hub: FakeHub, quick: RetryPolicy) -> None:
    publish(POLICY, quick)
    dataset = replace(POLICY, contents={"info.json": Content(b"{}")}, repo_type="dataset")
    publish(dataset, quick)
    assert "info.json" not in hub.store.commit("models/me/policy", "main").files
    assert "config.json" not in hub.store.commit("datasets/me/policy", "main").files
