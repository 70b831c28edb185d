"""`egovcp-dataset push` and `pull`."""

import hashlib
import json
import shutil
from pathlib import Path

import pytest

from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, Provenance, schema
from egovcp.data.committer import work_folder
from egovcp.testing import random_episode
from egovcp_collect.dataset.cli import main
from tests.support.hub import FakeHub
from tests.support.hub.faults import HubFaultKind

from .episodes import ARM

REPO = "datasets/me/six"
QUICK = ("--network.attempts=2", "--network.wait_s=0.01", "--network.timeout_s=20")
TOKEN = "hf_NobodyMayEverSeeThis"


def write(root: Path, episodes: int = 6, shard: int = 4) -> Path:
    """A dataset of random episodes of two tasks."""
    provenance = Provenance("stance-1", seed=0, origin="simulated")
    with DatasetWriter(root, provenance, shard_episodes=shard) as writer:
        for number in range(episodes):
            writer.add(random_episode(number, task=("ball", "wall")[number % 2]))
    return root


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write(tmp_path / "six")


def push(root: Path, *flags: str) -> int:
    return main(["push", str(root), "--repo_id=me/six", *QUICK, *flags])


def pull(target: Path, *flags: str) -> int:
    return main(["pull", "me/six", f"--output_dir={target}", *QUICK, *flags])


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file but the card and the note of where it came from."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and path.name != "README.md" and path != folder / schema.SOURCE_PATH
    }


def test_a_pulled_dataset_equals_the_pushed_one(
    hub: FakeHub, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (root / "assets").mkdir()
    (root / "assets/events.png").write_bytes(b"\x89PNG a picture")
    assert push(root, f"--json={tmp_path / 'push.json'}") == 0
    commit = json.loads((tmp_path / "push.json").read_text())["commit"]
    train = f"egovcp-train --dataset.repo_id=me/six --dataset.revision={commit}"
    assert capsys.readouterr().out.splitlines() == [f"me/six@main is now {commit}", train]
    assert hub.store.refs(REPO).tags == {"v3.0": commit}

    copy = tmp_path / "copy"
    assert pull(copy, f"--json={tmp_path / 'pull.json'}") == 0
    assert hashes(copy) == hashes(root)
    assert json.loads((tmp_path / "pull.json").read_text()) == {
        "repo_id": "me/six",
        "commit": commit,
        "root": str(copy),
        "episodes": 6,
        "frames": 72,
    }
    source = DatasetReader.open(DatasetConfig(root=str(copy))).source
    assert (source.repo_id, source.commit) == ("me/six", commit)
    assert sorted(p.name for p in tmp_path.glob(".*")) == []
    assert "me/six" in (copy / "README.md").read_text()


def published_card(hub: FakeHub) -> str:
    file = hub.store.commit(REPO, "main").files["README.md"]
    return hub.store.blob(file.sha256).read_text(encoding="utf-8")


def test_a_card_in_the_folder_is_published_as_it_is(
    hub: FakeHub, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (root / "README.md").write_text("edited by hand\n")
    assert push(root) == 0
    assert published_card(hub) == "edited by hand\n"
    assert "README.md is published as it is" in capsys.readouterr().out


def test_a_dataset_of_another_robot_is_published_with_a_card(
    hub: FakeHub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with DatasetWriter(tmp_path / "arm", Provenance("arm-1", seed=0)) as writer:
        writer.add(random_episode(0, task="reach", robot=ARM))
    assert push(tmp_path / "arm") == 0
    assert "the card names no licence" in capsys.readouterr().out
    text = published_card(hub)
    assert "| `observation.images.ego_depth` | image, uint16 | (32, 48, 1) |" in text
    assert "| `b` | -2.0 | 0.0 | 2.0 |" in text
    assert "angle.a" in text
    for word in ("G1", "hand", "pelvis", "## Statistics", "env.delay"):
        assert word not in text, word


def test_pushing_again_completes_the_tag_only(hub: FakeHub, root: Path) -> None:
    hub.fail("tag", 503)
    assert push(root) == 5
    head = hub.store.refs(REPO).branches["main"]
    hub.reset()
    assert push(root, "--tag=first") == 0
    assert hub.store.refs(REPO).tags == {"v3.0": head, "first": head}
    assert push(root) == 0
    assert hub.store.refs(REPO).branches["main"] == head
    assert hub.requests["commit"] == 0


def test_a_shorter_version_leaves_no_stale_files(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    assert push(root) == 0
    assert push(write(tmp_path / "short", episodes=3)) == 0
    assert pull(tmp_path / "copy") == 0
    assert hashes(tmp_path / "copy") == hashes(tmp_path / "short")


def test_an_older_revision_can_be_pulled(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    assert push(root, "--tag=first") == 0
    assert push(write(tmp_path / "short", episodes=3)) == 0
    assert pull(tmp_path / "copy", "--dataset.revision=first") == 0
    assert hashes(tmp_path / "copy") == hashes(root)


def test_a_pulled_dataset_can_be_pushed_on(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    assert push(root) == 0
    assert pull(tmp_path / "copy") == 0
    before = hub.store.refs(REPO)
    assert push(tmp_path / "copy") == 0
    assert hub.store.refs(REPO) == before
    assert schema.SOURCE_PATH not in hub.store.commit(REPO, "main").files


@pytest.mark.parametrize(
    "name", ["data/chunk-000/file-001.parquet", schema.INFO_PATH, schema.STATS_PATH]
)
def test_a_damaged_dataset_is_not_published(
    hub: FakeHub, root: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    content = bytearray((root / name).read_bytes())
    content[len(content) // 2] ^= 1
    (root / name).write_bytes(content)
    assert push(root) == 3
    assert name in capsys.readouterr().err
    assert not hub.requests


def test_an_unfinished_collection_is_not_published(
    hub: FakeHub, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work_folder(root).mkdir()
    assert push(root) == 3
    assert "egovcp-collect --resume" in capsys.readouterr().err
    assert not hub.requests


def test_a_link_is_not_followed(
    hub: FakeHub, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "secret").write_text("secret")
    (root / "assets").mkdir()
    (root / "assets/events.png").symlink_to(tmp_path / "secret")
    assert push(root) == 3
    assert "events.png is a link" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["info", "coverage"])
def test_a_revision_is_resolved_once(hub: FakeHub, root: Path, command: str) -> None:
    assert push(root) == 0
    hub.reset()
    assert main([command, "me/six"]) == 0
    assert hub.requests["info"] == 1


def test_a_failed_pull_continues(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    assert push(root) == 0
    hub.reset()
    hub.fail("resolve", 503, after=4)
    assert pull(tmp_path / "copy") == 5
    assert not (tmp_path / "copy").exists()
    done = hub.requests["resolve"]
    hub.reset()
    assert pull(tmp_path / "copy") == 0
    files = set(hub.store.commit(REPO, "main").files) - {".gitattributes"}
    assert hub.requests["resolve"] == len(files) - 4 < done + len(files)
    assert hashes(tmp_path / "copy") == hashes(root)


def test_a_pull_without_any_file_leaves_no_folder(hub: FakeHub, root: Path, tmp_path: Path) -> None:
    assert push(root) == 0
    hub.fail("resolve", 403)
    assert pull(tmp_path / "copy") == 5
    assert not list(tmp_path.glob("*copy*"))


def test_a_folder_is_not_overwritten(
    hub: FakeHub, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert push(root) == 0
    assert pull(root) == 2
    assert pull(tmp_path / "copy") == 0
    capsys.readouterr()
    assert pull(tmp_path / "copy") == 0
    assert "already" in capsys.readouterr().out
    (tmp_path / "copy/meta/stats.json").write_text("{}")
    assert pull(tmp_path / "copy") == 3


def test_a_damaged_dataset_on_the_hub_does_not_appear(
    hub: FakeHub, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert push(root) == 0
    other = hub.store.add_small(b"{}\n")
    hub.store.advance(REPO, "main", "", "by hand", {schema.STATS_PATH: other})
    assert pull(tmp_path / "copy") == 3
    assert "stats.json" in capsys.readouterr().err
    assert not list(tmp_path.glob("*copy*"))


@pytest.mark.parametrize("kind", [401, 404, 503, "reset", "lose"])
@pytest.mark.parametrize("command", ["push", "pull"])
def test_the_token_is_never_shown(
    hub: FakeHub,
    root: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    command: str,
    kind: HubFaultKind,
) -> None:
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    caplog.set_level("DEBUG")
    if command == "pull":
        assert push(root) == 0
    hub.fail("commit" if command == "push" else "resolve", kind)
    run = push if command == "push" else pull
    code = run(root if command == "push" else tmp_path / "copy", "--debug")
    assert code in ({0, 5} if kind == "lose" else {3 if kind == 404 else 5})
    shown = capfd.readouterr()
    assert TOKEN not in shown.out + shown.err + caplog.text
    if code:
        assert shown.err.splitlines()[-1].startswith(f"egovcp-dataset {command}: error: ")
    hub.reset()
    shutil.rmtree(tmp_path / "hub")
    written = b"".join(p.read_bytes() for p in tmp_path.rglob("*") if p.is_file())
    assert TOKEN.encode() not in written


def test_a_token_repeated_by_the_server_is_not_shown(
    hub: FakeHub,
    root: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    hub.fail("commit", 418, message=f"no, {TOKEN}")
    assert push(root, "--debug") == 5
    shown = capfd.readouterr().err
    assert "no, <token>" in shown
    assert TOKEN not in shown


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["push", "me/none", "--repo_id=me/six"], "takes the folder"),
        (["push", ".", "--repo_id=six"], "expected user/name"),
        (["pull", "--dataset.root=x", "--output_dir=y"], "takes the id"),
        (["pull", "me/six"], "--output_dir is missing"),
    ],
)
def test_misuse_is_a_usage_error(
    args: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(args) == 2
    assert message in capsys.readouterr().err
