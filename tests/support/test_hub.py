"""The fake Hub does what Hugging Face's library expects of the real one."""

import http.client
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import huggingface_hub
import pytest
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi
from huggingface_hub.errors import (
    HfHubHTTPError,
    RemoteEntryNotFoundError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)

from tests.support.hub import FakeHub, files, redirect_hub

REPO = "me/things"
ROOT = Path(__file__).resolve().parents[2]
LARGE = bytes(range(256)) * 100


@pytest.fixture
def api(hub: FakeHub) -> HfApi:
    """A client; `me/things` holds a small and a large file."""
    api = HfApi()
    api.create_repo(REPO, repo_type="dataset")
    commit(api, CommitOperationAdd("README.md", b"---\nlicense: mit\n---\n"))
    commit(api, CommitOperationAdd("data/a/large.parquet", LARGE))
    return api


def commit(
    api: HfApi, *operations: CommitOperationAdd | CommitOperationDelete, parent: str | None = None
) -> str:
    made = api.create_commit(
        REPO, operations, commit_message="m", repo_type="dataset", parent_commit=parent
    )
    return str(made.oid)


def test_a_repository_is_made_once(api: HfApi) -> None:
    assert api.create_repo(REPO, repo_type="dataset", exist_ok=True).repo_id == REPO
    with pytest.raises(HfHubHTTPError, match="409"):
        api.create_repo(REPO, repo_type="dataset")
    with pytest.raises(RepositoryNotFoundError):
        api.dataset_info("me/none")


def test_uploaded_files_can_be_read(api: HfApi, tmp_path: Path) -> None:
    assert set(api.list_repo_files(REPO, repo_type="dataset")) == {
        ".gitattributes",
        "README.md",
        "data/a/large.parquet",
    }
    folder = huggingface_hub.snapshot_download(REPO, repo_type="dataset", cache_dir=tmp_path / "c")
    assert (Path(folder) / "data/a/large.parquet").read_bytes() == LARGE
    with pytest.raises(RemoteEntryNotFoundError):
        api.hf_hub_download(REPO, "none", repo_type="dataset", cache_dir=tmp_path / "c")


def test_any_part_of_a_file_can_be_read(api: HfApi) -> None:
    with huggingface_hub.HfFileSystem().open(f"datasets/{REPO}/data/a/large.parquet") as file:
        file.seek(300)
        assert file.read(5) == LARGE[300:305]
        file.seek(-3, 2)
        assert file.read() == LARGE[-3:]


def test_large_content_is_uploaded_once(api: HfApi, hub: FakeHub) -> None:
    hub.reset()
    commit(api, CommitOperationAdd("data/b/same.parquet", LARGE))
    assert (hub.requests["lfs_batch"], hub.requests["lfs_upload"]) == (1, 0)


def test_a_commit_is_all_or_nothing(api: HfApi) -> None:
    before = api.dataset_info(REPO).sha
    with pytest.raises(RemoteEntryNotFoundError):
        commit(api, CommitOperationAdd("new", b"x"), CommitOperationDelete("none"))
    assert api.dataset_info(REPO).sha == before
    after = commit(api, CommitOperationDelete("data/", is_folder=True), parent=before)
    assert set(api.list_repo_files(REPO, repo_type="dataset")) == {".gitattributes", "README.md"}
    with pytest.raises(HfHubHTTPError, match="412"):
        commit(api, CommitOperationAdd("new", b"x"), parent=before)
    assert [c.commit_id for c in api.list_repo_commits(REPO, repo_type="dataset")][:2] == [
        after,
        before,
    ]


def test_revisions_have_names(api: HfApi) -> None:
    first = api.dataset_info(REPO).sha
    api.create_tag(REPO, tag="v3.0", repo_type="dataset")
    api.create_branch(REPO, branch="feature/x", repo_type="dataset")
    second = commit(api, CommitOperationAdd("new", b"x"))
    assert api.dataset_info(REPO, revision="v3.0").sha == first
    assert api.dataset_info(REPO, revision="feature/x").sha == first
    assert api.dataset_info(REPO, revision=second[:8]).sha == second
    refs = api.list_repo_refs(REPO, repo_type="dataset")
    assert {b.name: b.target_commit for b in refs.branches} == {"main": second, "feature/x": first}
    with pytest.raises(HfHubHTTPError, match="409"):
        api.create_tag(REPO, tag="v3.0", repo_type="dataset")
    api.delete_tag(REPO, tag="v3.0", repo_type="dataset")
    with pytest.raises(RevisionNotFoundError):
        api.dataset_info(REPO, revision="v3.0")
    api.delete_branch(REPO, branch="feature/x", repo_type="dataset")


def test_long_listings_come_in_pages(api: HfApi, monkeypatch: pytest.MonkeyPatch) -> None:
    commit(api, *(CommitOperationAdd(f"many/{i}", b"%d" % i) for i in range(7)))
    monkeypatch.setattr(files, "_PAGE", 3)
    listed = api.list_repo_tree(REPO, "many", repo_type="dataset")
    assert sorted(entry.path for entry in listed) == [f"many/{i}" for i in range(7)]


@pytest.fixture
def locked(tmp_path: Path) -> Iterator[FakeHub]:
    """A Hub that wants a token."""
    with (
        FakeHub(tmp_path / "hub", token="hf_right") as hub,
        redirect_hub(hub.endpoint, tmp_path / "home"),
    ):
        yield hub


def test_a_token_is_needed_to_write_and_to_read_private_data(locked: FakeHub) -> None:
    owner, other = HfApi(token="hf_right"), HfApi(token="hf_wrong")
    with pytest.raises(HfHubHTTPError, match="401"):
        other.create_repo(REPO, repo_type="dataset")
    owner.create_repo(REPO, repo_type="dataset")
    owner.create_repo("me/secret", repo_type="dataset", private=True)
    assert other.dataset_info(REPO).private is False
    with pytest.raises(HfHubHTTPError, match="401"):
        other.dataset_info("me/secret")
    assert owner.dataset_info("me/secret").private is True
    with pytest.raises(HfHubHTTPError, match="401"):
        commit(other, CommitOperationAdd("new", b"x"))


def test_repositories_outlive_the_server(api: HfApi, hub: FakeHub, tmp_path: Path) -> None:
    head = api.dataset_info(REPO).sha
    with FakeHub(hub.store.root) as other:
        assert HfApi(endpoint=other.endpoint).dataset_info(REPO).sha == head


def test_faults_apply_to_the_given_requests(api: HfApi, hub: FakeHub) -> None:
    hub.reset()
    hub.fail("info", 418, times=1, after=1, message="out of tea")
    api.dataset_info(REPO)
    with pytest.raises(HfHubHTTPError, match="out of tea"):
        api.dataset_info(REPO)
    api.dataset_info(REPO)
    assert hub.requests == {"info": 3}


def test_a_connection_is_kept_after_an_answer_without_a_body(api: HfApi, hub: FakeHub) -> None:
    """A client may send its next request before it notices that the server has closed."""
    hub.fail("metadata", "truncate")
    connection = http.client.HTTPConnection(hub.endpoint.removeprefix("http://"), timeout=20)
    for _ in range(2):
        connection.request("HEAD", f"/datasets/{REPO}/resolve/main/README.md")
        answer = connection.getresponse()
        assert (answer.status, answer.read(), answer.will_close) == (200, b"", False)
    connection.close()


def test_the_command_prints_its_endpoint(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.support.hub", "--root", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        endpoint = line.removeprefix("export HF_ENDPOINT=").split()[0]
        assert HfApi(endpoint=endpoint).create_repo(REPO, repo_type="dataset").repo_id == REPO
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0
