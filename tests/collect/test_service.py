"""`egovcp-collect` as a process: stopped, killed, resumed, extended."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from egovcp.data import DatasetConfig, DatasetReader
from egovcp.data.committer import work_folder
from egovcp.data.metadata import verify_hashes
from egovcp_collect.collect import main

_SHORT = (
    "--task=ball",
    "--seed=3",
    "--env.controller=stance",
    "--env.ball_episode.ticks=6",
    "--env.ball_episode.event_ticks=[0,1]",
)
_SMALL = ("--num_envs=2", "--shard_episodes=4")

#: As the console script starts it, so that the workers import only what they need.
_START = "import sys; from egovcp_collect.commands import collect; sys.exit(collect())"
_COMMAND = (sys.executable, "-c", _START, *_SHORT, *_SMALL)

type Tree = dict[str, bytes]


def _tree(root: Path) -> Tree:
    """The files that depend on the episodes alone."""
    return {
        str(p.relative_to(root)): p.read_bytes()
        for p in root.rglob("*")
        if p.is_file() and p.name not in ("collection.json", "sha256.json")
    }


@pytest.fixture(scope="module")
def ten(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten episodes from one uninterrupted run."""
    root = tmp_path_factory.mktemp("service") / "ten"
    assert main([*_SHORT, *_SMALL, f"--dataset.root={root}", "--episodes=10"]) == 0
    return root


@pytest.fixture
def endless(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A long collection into ``cut``, in a new process group, with at least one staged episode."""
    process = subprocess.Popen(
        [
            *_COMMAND,
            f"--dataset.root={tmp_path / 'cut'}",
            "--episodes=10000",
            "--num_workers=1",
            "--worker_timeout=6",
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    _wait_for(lambda: any(_staged(tmp_path / "cut").glob("*.arrow")))
    yield process
    process.kill()
    process.wait()


def _staged(root: Path) -> Path:
    return work_folder(root) / "sealed"


def _staged_names(root: Path) -> set[str]:
    return {path.name for path in _staged(root).glob("*.arrow")}


def _wait_for(condition: object) -> None:
    deadline = time.monotonic() + 100
    while time.monotonic() < deadline:
        if condition():  # type: ignore[operator]
            return
        time.sleep(0.02)
    raise TimeoutError("nothing happened")


def _require_resumable(root: Path, ten: Path) -> None:
    """Resume ``root``; its ten episodes must equal those of the uninterrupted run."""
    if root.exists():
        verify_hashes(root)
    flags = [*_SHORT, "--num_envs=5", "--num_workers=2", f"--dataset.root={root}", "--resume"]
    have = len(DatasetReader.open(DatasetConfig(root=str(root)))) if root.exists() else 0
    assert main([*flags, f"--episodes={max(10, have)}", "--shard_episodes=4"]) == 0
    reader, expected = (DatasetReader.open(DatasetConfig(root=str(r))) for r in (root, ten))
    for i in range(10):
        assert reader.read(i).digest() == expected.read(i).digest()
    if have <= 10 and len(reader) == 10:
        assert _tree(root) == _tree(ten)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_collection_and_keeps_finished_episodes(
    endless: subprocess.Popen[str], tmp_path: Path, ten: Path, number: int
) -> None:
    os.killpg(endless.pid, number)  # a terminal signals the workers, too
    out, err = endless.communicate(timeout=10)
    assert endless.returncode == 130, err
    assert "Traceback" not in err
    root = tmp_path / "cut"
    count = len(DatasetReader.open(DatasetConfig(root=str(root)))) if root.exists() else 0
    assert out.strip().splitlines()[-1].startswith(f"{count} episodes, ")
    _require_resumable(root, ten)


def test_a_kill_loses_no_staged_episode(
    endless: subprocess.Popen[str], tmp_path: Path, ten: Path
) -> None:
    root = tmp_path / "cut"
    _wait_for(root.exists)
    endless.kill()
    endless.wait()
    _wait_for(lambda: not _running_workers(root))
    staged = {path.name for path in _staged(root).glob("*.arrow")}
    committed = len(DatasetReader.open(DatasetConfig(root=str(root))))
    assert committed >= 4
    _require_resumable(root, ten)
    count = len(DatasetReader.open(DatasetConfig(root=str(root))))
    lost = [n for n in staged if int(n[:9]) >= count and not (_staged(root) / n).exists()]
    assert lost == []


def _running_workers(root: Path) -> list[str]:
    """Workers of a collection."""
    out = subprocess.run(["pgrep", "-f", f"spawn_main.*{root}"], capture_output=True, text=True)
    return out.stdout.split()


def test_a_killed_worker_is_replaced(
    endless: subprocess.Popen[str], tmp_path: Path, ten: Path
) -> None:
    os.kill(_worker_of(endless.pid), signal.SIGKILL)
    before = max(_numbers(tmp_path / "cut"), default=0)
    _wait_for(lambda: max(_numbers(tmp_path / "cut"), default=0) > before + 4)
    assert endless.poll() is None
    os.killpg(endless.pid, signal.SIGINT)
    endless.communicate(timeout=10)
    _require_resumable(tmp_path / "cut", ten)


@pytest.mark.slow
def test_a_hung_worker_is_replaced(
    endless: subprocess.Popen[str], tmp_path: Path, ten: Path
) -> None:
    hung = _worker_of(endless.pid)
    os.kill(hung, signal.SIGSTOP)
    _wait_for(lambda: _worker_of(endless.pid) != hung)
    before = max(_numbers(tmp_path / "cut"), default=0)
    _wait_for(lambda: max(_numbers(tmp_path / "cut"), default=0) > before)
    os.killpg(endless.pid, signal.SIGINT)
    endless.communicate(timeout=10)
    _require_resumable(tmp_path / "cut", ten)


@pytest.mark.slow
def test_a_second_collector_is_refused(
    endless: subprocess.Popen[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "cut"
    began = time.monotonic()
    assert main([*_SHORT, *_SMALL, f"--dataset.root={root}", "--episodes=5", "--resume"]) == 5
    assert time.monotonic() - began < 1.0  # it waits for no lock
    assert f"being written by process {endless.pid}" in capsys.readouterr().err
    assert endless.poll() is None


def _worker_of(parent: int) -> int:
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    mine = (c for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes())
    return int(next(mine, 0))


def _numbers(root: Path) -> list[int]:
    """Numbers of staged episodes and of the last committed one."""
    staged = [int(path.name[:9]) for path in _staged(root).glob("*.arrow")]
    shards = len(list(root.glob("data/*/*.parquet")))
    return [*staged, 4 * shards - 1]


@pytest.mark.slow
def test_an_extended_dataset_equals_one_collected_at_once(tmp_path: Path, ten: Path) -> None:
    root = tmp_path / "grown"
    for episodes in (3, 9, 10):
        flags = [*_SHORT, *_SMALL, f"--dataset.root={root}", f"--episodes={episodes}", "--resume"]
        assert main(flags) == 0
    assert _tree(root) == _tree(ten)


def test_resuming_a_complete_collection_changes_nothing(
    ten: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = _tree(ten)
    flags = [*_SHORT, *_SMALL, f"--dataset.root={ten}", "--resume"]
    assert main([*flags, "--episodes=10"]) == 0
    assert capsys.readouterr().out.startswith("10 episodes, ")
    assert main([*flags, "--episodes=7"]) == 0
    assert "has 10 episodes, more than --episodes=7; none is removed" in capsys.readouterr().out
    assert _tree(ten) == before


@pytest.mark.parametrize(
    ("flag", "what"),
    [
        ("--seed=4", "--seed was 3, is 4"),
        ("--eta=0.2", "--eta was 1.0, is 0.2"),
        ("--env.ball.grace=0.2", "--env.ball.grace was 0.3, is 0.2"),
        ("--env.controller=walk", "low-level controller was"),
        ("--task=wall", "--task was ball, is wall"),
    ],
)
def test_resuming_with_other_settings_is_refused(
    ten: Path, capsys: pytest.CaptureFixture[str], flag: str, what: str
) -> None:
    before = _tree(ten)
    flags = [*_SHORT, *_SMALL, f"--dataset.root={ten}", "--resume", "--episodes=12", flag]
    assert main(flags) == 2
    assert what in capsys.readouterr().err
    assert _tree(ten) == before


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_killed_at_two_hundred_random_moments(tmp_path: Path, ten: Path) -> None:
    """Kill and resume the collection 200 times on one root."""
    root = tmp_path / "cut"
    command = [*_COMMAND, "--resume", f"--dataset.root={root}"]
    command += ["--episodes=100000", "--num_workers=2"]
    before = 0
    for n in range(200):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        moment = n * 0.618 % 1
        if n % 4:
            known = _staged_names(root)
            _wait_for(lambda known=known: _staged_names(root) - known)
            time.sleep(moment)
        else:
            time.sleep(6 * moment)
        process.kill()
        process.wait()
        if root.exists():
            verify_hashes(root)
            count = len(DatasetReader.open(DatasetConfig(root=str(root))))
            assert count >= before
            before = count
    assert before > 100
    _require_resumable(root, ten)
