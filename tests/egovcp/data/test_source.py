"""Datasets by id: LeRobot's local folder, a fake Hub on the loopback, and no network at all."""

import json
import threading
from collections.abc import Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import huggingface_hub.constants
import numpy as np
import pytest

from egovcp.data import DatasetConfig, DatasetReader, source
from egovcp.errors import DataError, EnvironmentFailure

_SHA = "0123456789abcdef0123456789abcdef01234567"


class _FakeHub(BaseHTTPRequestHandler):
    """One public dataset, `me/six`, at one commit; `me/broken` answers 503."""

    def __init__(self, *args: object, root: Path, log: list[str]) -> None:
        self.dataset = root
        self.requests = log
        super().__init__(*args)  # type: ignore[arg-type]

    def log_message(self, *args: object) -> None:
        pass

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        self.requests.append(self.path)
        parts = self.path.split("?")[0].strip("/").split("/")
        if "broken" in parts:
            return self._answer(503, b"")
        if "six" not in parts:
            return self._answer(404, b"{}", {"X-Error-Code": "RepoNotFound"})
        if parts[0] == "api" and parts[-1] not in ("main", _SHA):
            return self._answer(404, b"{}", {"X-Error-Code": "RevisionNotFound"})
        if parts[0] == "api":
            listing = self._tree() if "tree" in parts else self._description()
            return self._answer(200, json.dumps(listing).encode())
        content = (self.dataset / "/".join(parts[5:])).read_bytes()
        headers = {"X-Repo-Commit": _SHA, "ETag": f'"{hash(content) & (2**63 - 1):040x}"'}
        return self._answer(200, content, headers)

    def _tree(self) -> list[dict[str, object]]:
        files = [p for p in self.dataset.rglob("*") if p.is_file()]
        return [
            {"type": "file", "path": str(p.relative_to(self.dataset)), "oid": "0" * 40,
             "size": p.stat().st_size}
            for p in files
        ]  # fmt: skip

    def _description(self) -> dict[str, object]:
        names = [{"rfilename": f["path"]} for f in self._tree()]
        return {"id": "me/six", "sha": _SHA, "siblings": names, "private": False, "tags": []}

    def _answer(self, code: int, body: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(code)
        for key, value in (headers or {}).items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(body)


@pytest.fixture
def hub_log(
    dataset_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[list[str]]:
    """A fake Hub in place of the real one; yields the paths that it was asked for."""
    log: list[str] = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_FakeHub, root=dataset_root, log=log))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    _point_to(f"http://127.0.0.1:{server.server_port}", tmp_path, monkeypatch)
    yield log
    server.shutdown()
    server.server_close()
    thread.join()


def _point_to(endpoint: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_LEROBOT_HOME", str(home / "lerobot"))
    monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", endpoint)
    monkeypatch.setattr(
        huggingface_hub.constants,
        "HUGGINGFACE_CO_URL_TEMPLATE",
        endpoint + "/{repo_id}/resolve/{revision}/{filename}",
    )


def test_a_hub_dataset_is_fetched_and_its_commit_recorded(
    hub_log: list[str], reader: DatasetReader
) -> None:
    fetched = DatasetReader.open(DatasetConfig(repo_id="me/six"))
    assert fetched.source.commit == _SHA
    np.testing.assert_array_equal(fetched.read(4).depth, reader.read(4).depth)
    pinned = DatasetReader.open(DatasetConfig(repo_id="me/six", revision=_SHA))
    assert pinned.root == fetched.root


@pytest.mark.parametrize(
    ("repo_id", "revision", "message"),
    [("me/none", "", "no dataset me/none@main"), ("me/six", "v9", "but not me/six@v9")],
)
def test_what_the_hub_does_not_have_is_a_data_error(
    hub_log: list[str], repo_id: str, revision: str, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        DatasetReader.open(DatasetConfig(repo_id=repo_id, revision=revision))


def test_a_local_folder_never_asks_the_hub(
    hub_log: list[str], dataset_root: Path, tmp_path: Path
) -> None:
    DatasetReader.open(DatasetConfig(repo_id="me/six", root=str(dataset_root)))
    with pytest.raises(DataError, match="no dataset at"):
        DatasetReader.open(DatasetConfig(repo_id="me/six", root=str(tmp_path / "none")))
    home = source.lerobot_home() / "me"
    home.mkdir(parents=True)
    (home / "six").symlink_to(dataset_root)
    assert DatasetReader.open(DatasetConfig(repo_id="me/six")).root == home / "six"
    assert hub_log == []


def test_an_unreachable_hub_is_an_environment_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _point_to("http://127.0.0.1:9", tmp_path, monkeypatch)
    with pytest.raises(EnvironmentFailure, match="cannot fetch dataset me/six@main"):
        DatasetReader.open(DatasetConfig(repo_id="me/six"))
