"""What is published: all or nothing, and again until it is complete."""

from dataclasses import replace
from pathlib import Path

import pytest

from egovcp.errors import DataError, EgovcpError, EnvironmentFailure, UsageError
from egovcp.hub import Content, LostUpdate, Publication, RetryPolicy, ensure_repository, publish
from tests.support.hub import FakeHub, redirect_hub
from tests.support.hub.faults import HubFaultKind

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
    401: "not logged in.*hf auth login.*write access",
    403: "no permission.*write access",
    404: "no dataset me/small",
}
FAULT_KINDS: tuple[HubFaultKind, ...] = (401, 404, 503, "reset", "lose", "truncate")


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
@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_a_lasting_fault_is_reported_and_publishes_all_or_nothing(
    hub: FakeHub, publication: Publication, quick: RetryPolicy, route: str, kind: HubFaultKind
) -> None:
    hub.fail(route, kind)
    found = outcome(publication, quick)
    if isinstance(found, str):  # the work was done; only the answer was lost, or it was verified
        assert kind in ("lose", "truncate") or route == "lfs_verify"
        require_published(hub, publication, found)
    else:
        assert isinstance(found, DataError if kind == 404 else EnvironmentFailure)
        assert "\n" not in str(found)
    require_whole_or_nothing(hub, publication)
    assert hub.requests[route] <= 2 * quick.attempts
    hub.reset()
    require_published(hub, publication, publish(publication, HEALTHY).commit)


@pytest.mark.parametrize(("status", "message"), REFUSALS.items())
@pytest.mark.parametrize("route", ["create", "lfs_batch", "commit"])
def test_a_refusal_names_the_remedy(
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
@pytest.mark.parametrize("kind", [503, "reset", "lose"])
def test_a_transient_fault_is_retried(
    hub: FakeHub, publication: Publication, route: str, kind: HubFaultKind
) -> None:
    hub.fail(route, kind, times=1)
    require_published(hub, publication, publish(publication, HEALTHY).commit)


@pytest.mark.parametrize("route", ["info", "lfs_upload", "commit", "tag"])
def test_a_silent_hub_times_out(hub: FakeHub, publication: Publication, route: str) -> None:
    hub.fail(route, "stall")
    found = outcome(publication, RetryPolicy(attempts=2, wait_s=0.01, timeout_s=0.5))
    if route != "info":  # it was done, as a second look shows
        require_published(hub, publication, str(found))
    else:
        assert isinstance(found, EnvironmentFailure)
        assert "ReadTimeout" in str(found)
    hub.reset()
    require_published(hub, publication, publish(publication, HEALTHY).commit)


def test_unchanged_content_is_not_sent_again(hub: FakeHub, publication: Publication) -> None:
    first = publish(publication, HEALTHY)
    assert first.new
    hub.reset()
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


def test_files_outside_the_owned_folders_are_kept(hub: FakeHub, publication: Publication) -> None:
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
    with pytest.raises(LostUpdate, match="another client has published to me/small@main"):
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


def test_a_private_publication_to_a_public_repository_is_refused(
    hub: FakeHub, publication: Publication
) -> None:
    publish(replace(publication, private=True), HEALTHY)
    assert hub.store.refs(REPO).private
    hub.store.create("datasets/me/public", private=False)
    with pytest.raises(UsageError, match="exists and is public"):
        publish(replace(publication, repo_id="me/public", private=True), HEALTHY)
    assert set(hub.store.commit("datasets/me/public", "main").files) == {".gitattributes"}


def test_a_new_branch_leaves_main_unchanged(hub: FakeHub, publication: Publication) -> None:
    tried = publish(replace(publication, branch="trial", moving_tag=""), HEALTHY)
    refs = hub.store.refs(REPO)
    assert refs.branches["trial"] == tried.commit != refs.branches["main"]
    assert not refs.tags


def test_retry_after_is_obeyed(
    hub: FakeHub, publication: Publication, caplog: pytest.LogCaptureFixture
) -> None:
    hub.fail("lfs_batch", 429, times=1, retry_after=2)
    publish(publication, HEALTHY)
    assert hub.requests["lfs_batch"] == 2
    assert "429 Too Many Requests" in caplog.text
    assert "trying again in 2 s" in caplog.text


def test_a_retry_after_above_the_limit_is_an_error(hub: FakeHub, publication: Publication) -> None:
    hub.fail("lfs_upload", 429, retry_after=3601)
    with pytest.raises(EnvironmentFailure, match=r"demands a pause of 3601 s.*longer than 300 s"):
        publish(publication, HEALTHY)


def test_a_wrong_id_is_a_usage_error(hub: FakeHub, publication: Publication) -> None:
    with pytest.raises(UsageError, match="is not the id of a dataset"):
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


POLICY = Publication("me/policy", {"config.json": Content(b"{}")}, "a policy", repo_type="model")


@pytest.fixture
def logged_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_right")


def test_ensure_repository_needs_a_token(
    hub: FakeHub, quick: RetryPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HF_TOKEN", raising=False)
    with pytest.raises(EnvironmentFailure, match=r"not logged in.*hf auth login"):
        ensure_repository(POLICY, quick)
    assert not hub.requests


@pytest.mark.usefixtures("logged_in")
def test_a_token_without_write_access_is_refused(tmp_path: Path, quick: RetryPolicy) -> None:
    with (
        FakeHub(tmp_path / "hub", token="hf_other") as hub,
        redirect_hub(hub.endpoint, tmp_path / "home"),
        pytest.raises(EnvironmentFailure, match="write access to models of me"),
    ):
        ensure_repository(POLICY, quick)


@pytest.mark.usefixtures("logged_in")
def test_ensure_repository_refuses_a_public_one_for_private_data(
    hub: FakeHub, quick: RetryPolicy
) -> None:
    ensure_repository(POLICY, quick)
    with pytest.raises(UsageError, match="is public, but a private repository was asked for"):
        ensure_repository(replace(POLICY, private=True), quick)


@pytest.mark.usefixtures("logged_in")
@pytest.mark.parametrize("private", [False, True])
def test_an_ensured_repository_is_empty_until_published(
    hub: FakeHub, quick: RetryPolicy, private: bool
) -> None:
    policy = replace(POLICY, private=private)
    ensure_repository(policy, quick)
    ensure_repository(policy, quick)
    assert "config.json" not in hub.store.commit("models/me/policy", "main").files
    assert hub.store.refs("models/me/policy").private == private
    commit = publish(policy, quick).commit
    assert hub.store.commit("models/me/policy", "main").sha == commit
    assert "config.json" in hub.store.commit("models/me/policy", "main").files


def test_a_model_and_a_dataset_may_share_a_name(hub: FakeHub, quick: RetryPolicy) -> None:
    publish(POLICY, quick)
    dataset = replace(POLICY, contents={"info.json": Content(b"{}")}, repo_type="dataset")
    publish(dataset, quick)
    assert "info.json" not in hub.store.commit("models/me/policy", "main").files
    assert "config.json" not in hub.store.commit("datasets/me/policy", "main").files
