"""Datasets by id on disk, on a fake Hub and without a network; selections of episodes."""

import logging
from pathlib import Path
from urllib.parse import urlsplit

import huggingface_hub
import numpy as np
import pytest

from egovcp.data import DatasetConfig, DatasetReader, source
from egovcp.data.source import select_episodes
from egovcp.errors import DataError, EnvironmentFailure, UsageError
from egovcp.hub import Content, Publication, RetryPolicy, publish
from tests.support.hub import FakeHub
from tests.support.hub.faults import HubFaultKind
from tests.support.ports import reserved_port

QUICK = RetryPolicy(attempts=2, wait_s=0.01, timeout_s=20)
SIX = DatasetConfig(repo_id="me/six")


@pytest.fixture
def commit(hub: FakeHub, dataset_root: Path) -> str:
    """The dataset of six episodes is on the Hub as `me/six`."""
    files = [path for path in dataset_root.rglob("*") if path.is_file()]
    contents = {path.relative_to(dataset_root).as_posix(): Content(path) for path in files}
    made = publish(Publication("me/six", contents, "six episodes"), QUICK).commit
    hub.reset()
    return made


def test_a_hub_dataset_is_fetched_and_its_commit_recorded(
    hub: FakeHub, commit: str, reader: DatasetReader
) -> None:
    fetched = DatasetReader.open(SIX)
    assert fetched.source.commit == commit
    np.testing.assert_array_equal(fetched.read(4).depth, reader.read(4).depth)
    hub.reset()
    pinned = DatasetReader.open(DatasetConfig(repo_id="me/six", revision=commit))
    assert pinned.root == fetched.root
    assert not hub.requests, "a commit that is here cannot have changed"


@pytest.mark.parametrize(
    ("repo_id", "revision", "message"),
    [("me/none", "", "no dataset me/none"), ("me/six", "v9", "but not me/six@v9")],
)
def test_what_the_hub_does_not_have_is_a_data_error(
    commit: str, repo_id: str, revision: str, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        DatasetReader.open(DatasetConfig(repo_id=repo_id, revision=revision))


def test_a_local_folder_does_not_contact_the_hub(
    hub: FakeHub, dataset_root: Path, tmp_path: Path
) -> None:
    DatasetReader.open(DatasetConfig(repo_id="me/six", root=str(dataset_root)))
    with pytest.raises(DataError, match="no such folder"):
        DatasetReader.open(DatasetConfig(repo_id="me/six", root=str(tmp_path / "none")))
    home = source.lerobot_home() / "me"
    home.mkdir(parents=True)
    (home / "six").symlink_to(dataset_root)
    assert DatasetReader.open(SIX).root == home / "six"
    assert not hub.requests


@pytest.mark.parametrize("route", ["info", "tree", "metadata", "resolve"])
@pytest.mark.parametrize("kind", [401, 503, "reset"])
def test_a_hub_that_fails_is_an_environment_failure(
    hub: FakeHub, commit: str, route: str, kind: HubFaultKind
) -> None:
    hub.fail(route, kind)
    with pytest.raises(EnvironmentFailure, match=r"hf auth login|cannot be used") as caught:
        source.locate(SIX, QUICK)
    assert "\n" not in str(caught.value)
    hub.reset()
    assert source.locate(SIX, QUICK).commit == commit


def test_no_server(hub: FakeHub, commit: str) -> None:
    port = urlsplit(hub.endpoint).port
    assert port
    hub.close()
    huggingface_hub.close_session()  # the fake Hub still serves connections that are open
    with (
        reserved_port(port),
        pytest.raises(EnvironmentFailure, match="cannot be used: ConnectError"),
    ):
        source.locate(SIX, QUICK)


def test_without_the_hub_an_earlier_download_is_used(
    hub: FakeHub, commit: str, caplog: pytest.LogCaptureFixture
) -> None:
    before = source.locate(SIX, QUICK)
    hub.fail("*", "reset")
    with caplog.at_level(logging.WARNING):
        assert source.locate(SIX, QUICK) == before
    assert f"earlier download of commit {commit}" in caplog.text


def test_the_source_of_a_downloaded_folder_is_stored_in_it(tmp_path: Path) -> None:
    noted = source.Source(tmp_path, "me/six", "0" * 40)
    source.write_source(noted)
    assert source.read_source(tmp_path) == noted
    assert source.read_source(tmp_path, "me/six") == noted
    assert source.read_source(tmp_path, "you/other").commit == ""
    (tmp_path / "meta/source.json").write_text("[]")
    with pytest.raises(DataError, match=r"source\.json is damaged"):
        source.read_source(tmp_path)


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("", range(10)),
        ("[3]", [3]),
        ("[5, 0, 7, 5]", [0, 5, 7]),
        ("5,0", [0, 5]),
        ("2:5", [2, 3, 4]),
        (":2", [0, 1]),
        ("8:", [8, 9]),
        ("[0:2, 9, 4:6]", [0, 1, 4, 5, 9]),
        ("(0:2, 9)", [0, 1, 9]),
    ],
)
def test_numbers_and_ranges(text: str, numbers: list[int]) -> None:
    np.testing.assert_array_equal(select_episodes(text, 10), numbers)


@pytest.mark.parametrize("text", ["0:11", "[3, 10]", "20:30", "0:999999999999"])
def test_episodes_out_of_range_are_refused_with_the_count(text: str) -> None:
    with pytest.raises(UsageError, match=r"the dataset has 10 episodes, 0 to 9"):
        select_episodes(text, 10)


@pytest.mark.parametrize("text", ["a", "[1, x]", "-1", "[]", "1:2:3", "1.5", f"[{'9' * 5000}]"])
def test_a_malformed_selection_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"is not an episode; expected numbers, \[0, 5, 7\]"):
        select_episodes(text, 10)


@pytest.mark.parametrize("text", ["5:5", "[5:3, 7]", "10:"])
def test_an_empty_range_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="selects no episode; there are 10"):
        select_episodes(text, 10)


def test_a_number_that_may_be_a_yaml_range_is_refused() -> None:
    """Unquoted, 1:30 is one minute and a half."""
    with pytest.raises(UsageError, match=r"write \[90\].*quote a range"):
        select_episodes("90", 100)
