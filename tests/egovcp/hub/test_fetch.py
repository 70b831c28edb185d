"""What is fetched: exactly the commit, whatever happens on the way."""

from pathlib import Path

import pytest

from egovcp.errors import DataError, EgovcpError, EnvironmentFailure
from egovcp.hub import (
    Content,
    Publication,
    RetryPolicy,
    fetch,
    is_local_path,
    is_repo_id,
    publish,
    resolve,
)
from tests.support.hub import FakeHub
from tests.support.hub.faults import HubFaultKind

HEALTHY = RetryPolicy(attempts=3, wait_s=0.01)
ROUTES = ("info", "tree", "metadata", "resolve")
FAULT_KINDS: tuple[HubFaultKind, ...] = (401, 404, 503, "reset", "truncate")


@pytest.fixture
def commit(hub: FakeHub, publication: Publication) -> str:
    """The publication is on the Hub."""
    made = publish(publication, HEALTHY).commit
    hub.reset()
    return made


def pull(folder: Path, retry: RetryPolicy) -> EgovcpError | None:
    """Resolve and fetch; the error, if there is one."""
    try:
        fetch("me/small", resolve("me/small", "v3.0", retry), folder, retry)
    except EgovcpError as error:
        return error
    return None


def require_same(folder: Path, publication: Publication) -> None:
    found = {
        path.relative_to(folder).as_posix(): Content(path).sha256
        for path in folder.rglob("*")
        if path.is_file()
    }
    assert found == {path: content.sha256 for path, content in publication.contents.items()}


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_a_lasting_fault_is_reported_and_the_next_fetch_succeeds(
    hub: FakeHub,
    publication: Publication,
    commit: str,
    quick: RetryPolicy,
    tmp_path: Path,
    route: str,
    kind: HubFaultKind,
) -> None:
    hub.fail(route, kind)
    error = pull(tmp_path / "folder", quick)
    if (route, kind) == ("metadata", "truncate"):
        assert error is None, "an answer without a body has nothing to truncate"
    else:
        assert isinstance(error, DataError if kind == 404 else EnvironmentFailure)
        assert "\n" not in str(error)
        if kind == 401:
            assert "hf auth login" in str(error)
            assert "read access to me/small" in str(error)
    hub.reset()
    assert pull(tmp_path / "folder", HEALTHY) is None
    require_same(tmp_path / "folder", publication)


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("kind", [503, "reset", "truncate"])
def test_a_transient_fault_is_retried(
    hub: FakeHub,
    publication: Publication,
    commit: str,
    tmp_path: Path,
    route: str,
    kind: HubFaultKind,
) -> None:
    hub.fail(route, kind, times=1)
    assert pull(tmp_path / "folder", HEALTHY) is None
    require_same(tmp_path / "folder", publication)


def test_a_silent_hub_times_out(
    hub: FakeHub, publication: Publication, commit: str, tmp_path: Path
) -> None:
    hub.fail("resolve", "stall")
    error = pull(tmp_path / "folder", RetryPolicy(attempts=2, wait_s=0.01, timeout_s=0.2))
    assert isinstance(error, EnvironmentFailure)
    assert "ReadTimeout" in str(error)


def test_downloaded_files_are_not_fetched_again(
    hub: FakeHub, publication: Publication, commit: str, quick: RetryPolicy, tmp_path: Path
) -> None:
    hub.fail("resolve", 503, after=2)
    assert pull(tmp_path / "folder", quick) is not None
    hub.reset()
    assert pull(tmp_path / "folder", HEALTHY) is None
    assert hub.requests["resolve"] == len(publication.contents) - 2


def test_foreign_files_are_removed(
    hub: FakeHub, publication: Publication, commit: str, tmp_path: Path
) -> None:
    (tmp_path / "folder/data").mkdir(parents=True)
    (tmp_path / "folder/data/old.parquet").write_bytes(b"old")
    fetch("me/small", commit, tmp_path / "folder", HEALTHY)
    require_same(tmp_path / "folder", publication)


def test_damaged_content_is_refused_and_fetched_anew(
    hub: FakeHub, publication: Publication, commit: str, tmp_path: Path
) -> None:
    name = "data/chunk-000/file-000.parquet"
    blob = hub.store.blob(publication.contents[name].sha256)
    sound = blob.read_bytes()
    blob.write_bytes(sound[:-1] + b"?")
    with pytest.raises(EnvironmentFailure, match=f"{name} differs from the Hub's hash"):
        fetch("me/small", commit, tmp_path / "folder", HEALTHY)
    blob.write_bytes(sound)
    fetch("me/small", commit, tmp_path / "folder", HEALTHY)
    require_same(tmp_path / "folder", publication)


def test_no_file_is_written_outside_the_folder(hub: FakeHub, commit: str, tmp_path: Path) -> None:
    file = hub.store.add_small(b"x")
    evil = hub.store.advance("datasets/me/small", "main", "", "evil", {"../evil": file}).sha
    with pytest.raises(DataError, match=r"'\.\./evil', a path outside"):
        fetch("me/small", evil, tmp_path / "folder", HEALTHY)
    assert not (tmp_path / "evil").exists()


@pytest.mark.parametrize(
    ("repo_id", "revision", "message"),
    [("me/none", "", "no dataset me/none"), ("me/small", "v9", "not me/small@v9")],
)
def test_what_the_hub_does_not_have_is_named(
    hub: FakeHub, commit: str, repo_id: str, revision: str, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        resolve(repo_id, revision, HEALTHY)


@pytest.mark.parametrize("text", ["user/name", "u/n", "my-org/ball.v2", "a_b/c-d", "7/x"])
def test_a_user_and_a_name_are_a_repo_id(text: str) -> None:
    assert is_repo_id(text)


@pytest.mark.parametrize(
    "text",
    [
        *("", "name", "/name", "user/", "a/b/c", "./ball", "../ball", "~/ball", "a/b--c"),
        *("a/b..c", "a/b.git", "a/b-", "a/.b", "a b/c", "a/b\n", "a/\0", "ü/b", f"a/{'b' * 95}"),
    ],
)
def test_anything_else_is_a_local_path(text: str) -> None:
    assert not is_repo_id(text)
    assert is_local_path(text)


def test_an_absent_folder_of_an_existing_parent_is_a_local_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert not is_local_path("runs/bal")
    (tmp_path / "runs").mkdir()
    assert is_local_path("runs/bal")


def test_a_file_or_a_broken_link_is_a_local_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "user").symlink_to("nowhere")
    assert not is_local_path("user/name")
    (tmp_path / "user").unlink()
    (tmp_path / "user").mkdir()
    (tmp_path / "user" / "name").symlink_to("name")
    assert is_local_path("user/name")
