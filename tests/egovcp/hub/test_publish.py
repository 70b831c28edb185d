"""What is published: all or nothing, and again until it is complete."""

from dataclasses import replace
from pathlib import Path

import pytest

from egovcp.errors import DataError, EgovcpError, EnvironmentFailure, UsageError
from egovcp.hub import Content, LostUpdate, Publication, RetryPolicy, publish
from tests.support.hub import FakeHub
from tests.support.hub.faults import Trouble

REPO = "datasets/me/small"
HEALTHY = RetryPolicy(attempts=3, wait_s=0.01)

#: Every request of a push to a new repository.
ROUTES = (
    "create",
    "info",
    "tree",
    "refs",
    "preupload",
    "lfs_batch",
    "lfs_upload",
    "lfs_verify",
    "validate",
    "commit",
    "tag",
)
REFUSALS = {
    401: "does not know you.*hf auth login.*write access",
    403: "may not do that.*write access",
    404: "no dataset me/small",
}
TROUBLES: tuple[Trouble, ...] = (*REFUSALS, 429, 503, "reset", "lose", "truncate")


def outcome(publication: Publication, retry: RetryPolicy) -> str | EgovcpError:
    """The commit, or the error."""
    try:
        return publish(publication, retry).commit
    except EgovcpError as error:
        return error


def require_whole_or_nothing(hub: FakeHub, publication: Publication) -> None:
    """There is no repository, or its head is the empty first commit or the whole publication."""
    if "me" not in {path.name for path in (hub.store.root / "repos").glob("datasets/*")}:
        return
    files = set(hub.store.commit(REPO, "main").files)
    assert files - {".gitattributes"} in (set(), set(publication.contents))


def require_published(hub: FakeHub, publication: Publication, commit: str) -> None:
    head = hub.store.commit(REPO, "main")
    assert head.sha == commit == hub.store.refs(REPO).tags["v3.0"]
    found = {path: f.sha256 for path, f in head.files.items() if path != ".gitattributes"}
    assert found == {path: content.sha256 for path, content in publication.contents.items()}


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("trouble", TROUBLES)
def test_trouble_that_lasts_ends_clearly_and_publishes_nothing_by_halves(
    hub: FakeHub, publication: Publication, quick: RetryPolicy, route: str, trouble: Trouble
) -> None:
    hub.fail(route, trouble, retry_after=0 if trouble == 429 else None)
    found = outcome(publication, quick)
    if isinstance(found, str):  # the work was done, only the answer was lost
        assert trouble in ("lose", "truncate")
        require_published(hub, publication, found)
    else:
        assert isinstance(found, DataError if trouble == 404 else EnvironmentFailure)
        assert "\n" not in str(found)
    require_whole_or_nothing(hub, publication)
    assert hub.requests[route] <= 2 * quick.attempts
    hub.heal()
    require_published(hub, publication, publish(publication, HEALTHY).commit)


@pytest.mark.parametrize(("status", "message"), REFUSALS.items())
@pytest.mark.parametrize("route", ["create", "lfs_batch", "commit"])
def test_a_refusal_says_what_to_do(
    hub: FakeHub,
    publication: Publication,
    quick: RetryPolicy,
    route: str,
    status: int,
    message: str,
) -> None:
    hub.fail(route, status)
    with pytest.raises(EgovcpError, match=message) as caught:
        publish(publication, quick)
    assert caught.value.exit_code == (3 if status == 404 else 5)
    assert hub.requests[route] == 1, "asking again does not help"


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("trouble", [503, "reset", "lose"])
def test_trouble_that_passes_is_not_noticed(
    hub: FakeHub, publication: Publication, route: str, trouble: Trouble
) -> None:
    hub.fail(route, trouble, times=1)
    require_published(hub, publication, publish(publication, HEALTHY).commit)


@pytest.mark.parametrize("route", ["info", "lfs_upload", "commit", "tag"])
def test_a_silent_hub_is_given_up(hub: FakeHub, publication: Publication, route: str) -> None:
    hub.fail(route, "stall")
    found = outcome(publication, RetryPolicy(attempts=2, wait_s=0.01, timeout_s=0.5))
    if route == "commit":  # it was made, as a second look shows
        require_published(hub, publication, str(found))
    else:
        assert isinstance(found, EnvironmentFailure)
        assert "ReadTimeout" in str(found)
    hub.heal()
    require_published(hub, publication, publish(publication, HEALTHY).commit)


def test_nothing_is_sent_twice(hub: FakeHub, publication: Publication) -> None:
    first = publish(publication, HEALTHY)
    assert first.new
    hub.heal()
    again = publish(publication, HEALTHY)
    assert again.commit == first.commit
    assert not again.new
    assert not {"preupload", "lfs_upload", "commit", "tag", "untag"} & set(hub.requests)


def test_a_new_version_replaces_the_old_one_and_the_tag_follows(
    hub: FakeHub, publication: Publication
) -> None:
    first = publish(replace(publication, tag="release-1"), HEALTHY)
    contents = dict(publication.contents)
    del contents["data/chunk-000/file-000.parquet"]
    contents["data/chunk-000/file-001.parquet"] = Content(b"other\0")
    newer = replace(publication, contents=contents)
    second = publish(newer, HEALTHY)
    require_published(hub, newer, second.commit)
    assert hub.store.commit(REPO, second.commit).parent == first.commit
    assert hub.store.refs(REPO).tags["release-1"] == first.commit


def test_what_others_put_beside_the_dataset_stays(hub: FakeHub, publication: Publication) -> None:
    publish(publication, HEALTHY)
    note = hub.store.add_small(b"a note")
    hub.store.advance(REPO, "main", "", "by hand", {"NOTES.md": note, "data/old.bin": note})
    publish(publication, HEALTHY)
    assert {"NOTES.md"} == set(hub.store.commit(REPO, "main").files) - {
        *publication.contents,
        ".gitattributes",
    }


def test_a_lost_update_is_refused(
    hub: FakeHub, publication: Publication, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody commits between the look and the commit."""
    from huggingface_hub import HfApi

    upload = HfApi.preupload_lfs_files

    def slow_upload(api: HfApi, *args: object, **options: object) -> None:
        upload(api, *args, **options)  # type: ignore[arg-type]
        hub.store.advance(REPO, "main", "", "theirs", {"theirs": hub.store.add_small(b"x")})

    monkeypatch.setattr(HfApi, "preupload_lfs_files", slow_upload)
    with pytest.raises(LostUpdate, match="somebody else has published to me/small@main"):
        publish(publication, HEALTHY)
    assert set(hub.store.commit(REPO, "main").files) == {".gitattributes", "theirs"}
    assert "v3.0" not in hub.store.refs(REPO).tags
    monkeypatch.undo()


def test_a_release_keeps_its_tag(hub: FakeHub, publication: Publication) -> None:
    release = replace(publication, tag="release-1")
    first = publish(release, HEALTHY)
    assert publish(release, HEALTHY) == replace(first, new=False)
    changed = {**publication.contents, "meta/info.json": Content(b'{"a": 1}\n')}
    with pytest.raises(UsageError, match="tag release-1 of me/small is commit"):
        publish(replace(release, contents=changed), HEALTHY)
    assert hub.store.commit(REPO, "main").sha == first.commit


def test_private_data_is_not_put_in_public(hub: FakeHub, publication: Publication) -> None:
    publish(replace(publication, private=True), HEALTHY)
    assert hub.store.refs(REPO).private
    hub.store.create("datasets/me/public", private=False)
    with pytest.raises(UsageError, match="exists and is public"):
        publish(replace(publication, repo_id="me/public", private=True), HEALTHY)
    assert set(hub.store.commit("datasets/me/public", "main").files) == {".gitattributes"}


def test_a_branch_is_made_and_leaves_main_alone(hub: FakeHub, publication: Publication) -> None:
    tried = publish(replace(publication, branch="trial", moving_tag=""), HEALTHY)
    refs = hub.store.refs(REPO)
    assert refs.branches["trial"] == tried.commit != refs.branches["main"]
    assert not refs.tags


def test_a_pause_that_the_hub_asks_for_is_made(
    hub: FakeHub, publication: Publication, caplog: pytest.LogCaptureFixture
) -> None:
    hub.fail("lfs_batch", 429, times=1, retry_after=2)
    publish(publication, HEALTHY)
    assert hub.requests["lfs_batch"] == 2
    assert "429 Too Many Requests; trying again in 2 s" in caplog.text


def test_but_not_a_pause_without_end(hub: FakeHub, publication: Publication) -> None:
    hub.fail("lfs_upload", 429, retry_after=3601)
    with pytest.raises(EnvironmentFailure, match=r"asks to wait 3601 s.*longer than 300 s"):
        publish(publication, HEALTHY)


def test_a_wrong_id_is_a_usage_error(hub: FakeHub, publication: Publication) -> None:
    with pytest.raises(UsageError, match="no id of a dataset"):
        publish(replace(publication, repo_id="me/a--b"), HEALTHY)
    assert not hub.requests


def test_a_large_file_is_read_from_disk(
    hub: FakeHub, publication: Publication, tmp_path: Path
) -> None:
    path = tmp_path / "large.parquet"
    path.write_bytes(bytes(3_000_000))
    contents = {**publication.contents, "data/large.parquet": Content(path)}
    commit = publish(replace(publication, contents=contents), HEALTHY).commit
    file = hub.store.commit(REPO, commit).files["data/large.parquet"]
    assert file.lfs
    assert hub.store.blob(file.sha256).read_bytes() == path.read_bytes()
