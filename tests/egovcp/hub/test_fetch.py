"""What is fetched: exactly the commit, whatever happens on the way."""

from pathlib import Path

import pytest

from egovcp.errors import DataError, EgovcpError, EnvironmentFailure
from egovcp.hub import Content, Publication, RetryPolicy, fetch, publish, resolve
from tests.support.hub import FakeHub
from tests.support.hub.faults import Trouble

HEALTHY = RetryPolicy(attempts=3, wait_s=0.01)
ROUTES = ("info", "tree", "metadata", "resolve")
TROUBLES: tuple[Trouble, ...] = (401, 403, 404, 429, 503, "reset", "truncate")


@pytest.fixture
def commit(hub: FakeHub, publication: Publication) -> str:
    """The publication is on the Hub."""
    made = publish(publication, HEALTHY).commit
    hub.heal()
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
@pytest.mark.parametrize("trouble", TROUBLES)
def test_trouble_that_lasts_ends_clearly_and_the_next_try_succeeds(
    hub: FakeHub,
    publication: Publication,
    commit: str,
    quick: RetryPolicy,
    tmp_path: Path,
    route: str,
    trouble: Trouble,
) -> None:
    hub.fail(route, trouble, retry_after=0 if trouble == 429 else None)
    error = pull(tmp_path / "folder", quick)
    if (route, trouble) == ("metadata", "truncate"):
        assert error is None, "an answer without a body has nothing to truncate"
    else:
        assert isinstance(error, DataError if trouble == 404 else EnvironmentFailure)
        assert "\n" not in str(error)
        if trouble in (401, 403):
            assert "hf auth login" in str(error)
            assert "read access to me/small" in str(error)
    hub.heal()
    assert pull(tmp_path / "folder", HEALTHY) is None
    require_same(tmp_path / "folder", publication)


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("trouble", [503, "reset", "truncate"])
def test_trouble_that_passes_is_not_noticed(
    hub: FakeHub,
    publication: Publication,
    commit: str,
    tmp_path: Path,
    route: str,
    trouble: Trouble,
) -> None:
    hub.fail(route, trouble, times=1)
    assert pull(tmp_path / "folder", HEALTHY) is None
    require_same(tmp_path / "folder", publication)


def test_a_silent_hub_is_given_up(
    hub: FakeHub, publication: Publication, commit: str, tmp_path: Path
) -> None:
    hub.fail("resolve", "stall")
    error = pull(tmp_path / "folder", RetryPolicy(attempts=2, wait_s=0.01, timeout_s=0.5))
    assert isinstance(error, EnvironmentFailure)
    assert "ReadTimeout" in str(error)


def test_files_that_have_arrived_are_not_fetched_again(
    hub: FakeHub, publication: Publication, commit: str, quick: RetryPolicy, tmp_path: Path
) -> None:
    hub.fail("resolve", 503, after=2)
    assert pull(tmp_path / "folder", quick) is not None
    hub.heal()
    assert pull(tmp_path / "folder", HEALTHY) is None
    assert hub.requests["resolve"] == len(publication.contents) - 2


def test_what_does_not_belong_goes(
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
    with pytest.raises(EnvironmentFailure, match=f"{name} is not what the Hub says"):
        fetch("me/small", commit, tmp_path / "folder", HEALTHY)
    blob.write_bytes(sound)
    fetch("me/small", commit, tmp_path / "folder", HEALTHY)
    require_same(tmp_path / "folder", publication)


def test_no_file_lands_outside_the_folder(hub: FakeHub, commit: str, tmp_path: Path) -> None:
    file = hub.store.add_small(b"x")
    evil = hub.store.advance("datasets/me/small", "main", "", "evil", {"../evil": file}).sha
    with pytest.raises(DataError, match=r"'\.\./evil', a place outside"):
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
