"""Where an artifact lies: in a folder, or on the Hub at a revision."""

import json
from pathlib import Path

import pytest

from egovcp.artifact import WEIGHTS, load_artifact
from egovcp.errors import ArtifactError, EnvironmentFailure, UsageError
from egovcp.hub import Content, Publication, publish
from egovcp.manifest import MANIFEST, sealed
from tests.support.hub import FakeHub
from tests.support.hub.faults import HubFaultKind

from .conftest import FILES, QUICK


@pytest.fixture
def commit(hub: FakeHub, original: Path) -> str:
    """The artifact is on the Hub as model `me/policy`, with a card and a file that is code."""
    contents = {path.name: Content(path) for path in original.iterdir()}
    extra = {"README.md": Content(b"---\nlicense: mit\n---\n"), "modeling.py": Content(b"raise")}
    publication = Publication("me/policy", contents | extra, "a policy", repo_type="model")
    made = publish(publication, QUICK).commit
    hub.reset()
    return made


@pytest.mark.parametrize("path", ["./absent", "/absent/policy", "absent", "a/b/c", "a/b--c", "/"])
def test_a_path_without_artifact_is_refused_without_network(hub: FakeHub, path: str) -> None:
    with pytest.raises(ArtifactError, match=rf"no such folder: '{path}'|{MANIFEST}"):
        load_artifact(path)
    assert not hub.requests


def test_a_file_is_no_artifact(original: Path) -> None:
    with pytest.raises(ArtifactError, match="not a folder"):
        load_artifact(str(original / WEIGHTS))


def test_a_folder_has_no_revision(original: Path) -> None:
    with pytest.raises(UsageError, match="is a folder, and revision v1"):
        load_artifact(str(original), "v1")


def test_other_files_beside_the_artifact_are_ignored(folder: Path) -> None:
    (folder / "README.md").write_text("# A policy")
    (folder / "assets").mkdir()
    load_artifact(str(folder))


def test_a_hub_id_is_fetched_at_its_revision(hub: FakeHub, original: Path, commit: str) -> None:
    newer = {path.name: Content(path) for path in original.iterdir()}
    manifest = json.loads((original / MANIFEST).read_text()) | {"controller_id": "walker-2"}
    newer[MANIFEST] = Content(json.dumps(sealed(manifest)).encode())
    publish(Publication("me/policy", newer, "another", repo_type="model"), QUICK)
    assert load_artifact("me/policy").controller_id == "walker-2"
    pinned = load_artifact("me/policy", commit)
    assert pinned.controller_id == "stance-1"
    assert pinned.path.name == commit
    hub.reset()
    load_artifact("me/policy", commit)
    assert not hub.requests, "a commit that is here cannot have changed"


def test_a_hub_id_beside_a_folder_of_its_user_needs_a_revision(
    commit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "me").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ArtifactError, match="with a revision such as main if a folder 'user'"):
        load_artifact("me/policy")
    assert load_artifact("me/policy", "main").path.name == commit


def test_only_data_is_fetched(hub: FakeHub, commit: str) -> None:
    found = load_artifact("me/policy", commit).path
    assert {path.name for path in found.iterdir()} == FILES


def test_a_dataset_of_that_name_is_no_policy(hub: FakeHub, original: Path) -> None:
    contents = {path.name: Content(path) for path in original.iterdir()}
    publish(Publication("me/ball", contents, "a dataset"), QUICK)
    with pytest.raises(ArtifactError, match="the Hub has no model me/ball"):
        load_artifact("me/ball")


@pytest.mark.parametrize(
    ("name", "revision", "message"),
    [("me/none", "", "no model me/none"), ("me/policy", "v9", "but not me/policy@v9")],
)
def test_an_unknown_hub_id_is_an_artifact_error(
    commit: str, name: str, revision: str, message: str
) -> None:
    with pytest.raises(ArtifactError, match=message):
        load_artifact(name, revision, QUICK)


@pytest.mark.parametrize("kind", [403, 429, 503, "reset"])
def test_hub_errors_are_retried_and_then_reported(
    hub: FakeHub, commit: str, kind: HubFaultKind
) -> None:
    hub.fail("*", kind, retry_after=0 if kind == 429 else None)
    with pytest.raises(EnvironmentFailure) as caught:
        load_artifact("me/policy", "", QUICK)
    assert "\n" not in str(caught.value)
    assert sum(hub.requests.values()) == (1 if kind == 403 else QUICK.attempts)
    hub.reset()
    hub.fail("*", kind, times=1, retry_after=0 if kind == 429 else None)
    if kind != 403:
        assert load_artifact("me/policy", "", QUICK).path.name == commit


def test_without_the_hub_an_earlier_download_serves(
    hub: FakeHub, commit: str, caplog: pytest.LogCaptureFixture
) -> None:
    load_artifact("me/policy", "", QUICK)
    hub.fail("*", 503)
    assert load_artifact("me/policy", "", QUICK).path.name == commit
    assert f"earlier download of commit {commit}" in caplog.text


def test_a_changed_file_on_the_hub_is_refused(hub: FakeHub, original: Path) -> None:
    contents = {path.name: Content(path) for path in original.iterdir()}
    contents[WEIGHTS] = Content(b"x" + (original / WEIGHTS).read_bytes()[1:])
    publish(Publication("me/odd", contents, "tampered", repo_type="model"), QUICK)
    with pytest.raises(ArtifactError, match=f"{WEIGHTS}.*SHA-256"):
        load_artifact("me/odd")
