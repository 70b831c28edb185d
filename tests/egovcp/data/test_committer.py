import errno
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from egovcp.checks.dataset import dataset_problems
from egovcp.data import (
    DatasetConfig,
    DatasetReader,
    DatasetWriter,
    Episode,
    Provenance,
    dataset_files,
)
from egovcp.data.committer import Committer, open_committer, work_folder
from egovcp.data.metadata import verify_hashes
from egovcp.data.staging import encode
from egovcp.errors import DataError, EnvironmentFailure, UsageError

_RUN = Provenance("stance-1", seed=0, command="collect", versions={"a": "1"}, config={"task": "x"})
_SHARD = 2

type Tree = dict[str, bytes]


def _agree(provenance: Provenance) -> None:
    assert provenance == _RUN


def _seal(committer: Committer, episodes: Sequence[Episode], numbers: Sequence[int]) -> None:
    for number in numbers:
        committer.staging.put(number, encode(episodes[number]))
        committer.mark_staged(number)


def _tree(root: Path) -> Tree:
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, episodes: list[Episode]) -> list[Tree]:
    """The dataset of the first n of six episodes, for every n; None where there is nothing."""
    trees: list[Tree] = [{}]
    for count in range(1, len(episodes) + 1):
        root = tmp_path_factory.mktemp("whole") / "d"
        with DatasetWriter(root, _RUN, _SHARD) as writer:
            for episode in episodes[:count]:
                writer.add(episode)
        trees.append(_tree(root))
    return trees


def _commit_all(root: Path, episodes: list[Episode], steps: Sequence[int]) -> None:
    """Commit after so many episodes each, in one run each."""
    done = 0
    for count in steps:
        with open_committer(root, _RUN, _SHARD, _agree) as committer:
            assert committer.committed == done
            _seal(committer, episodes, range(done, done + count))
            assert committer.commit() == list(range(done, done + count))
            done += count


@pytest.mark.parametrize(
    "steps",
    [
        *([6], [1] * 6, [1, 4, 1]),
        *(pytest.param(steps, marks=pytest.mark.slow) for steps in ([2, 2, 2], [3, 3], [5, 1])),
    ],
)
def test_the_dataset_does_not_depend_on_the_number_of_commits(
    tmp_path: Path, episodes: list[Episode], whole: list[Tree], steps: list[int]
) -> None:
    root = tmp_path / "d"
    _commit_all(root, episodes, steps)
    assert _tree(root) == whole[6]
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


def test_only_episodes_without_a_gap_before_them_are_committed(
    tmp_path: Path, episodes: list[Episode], whole: list[Tree]
) -> None:
    root = tmp_path / "d"
    with open_committer(root, _RUN, _SHARD) as committer:
        _seal(committer, episodes, [4, 0, 1, 2])
        assert committer.missing(6) == [3, 5]
        assert committer.next_shard_is_complete
        assert committer.commit() == [0, 1, 2]
        assert not committer.next_shard_is_complete
        assert committer.missing(6) == [3, 5]
    assert _tree(root) == whole[3]
    with open_committer(root, _RUN, _SHARD, _agree) as committer:
        assert (committer.committed, committer.staged) == (3, 1)
        _seal(committer, episodes, [5, 3])
        committer.commit()
    assert _tree(root) == whole[6]


def test_a_commit_keeps_other_files(
    tmp_path: Path, episodes: list[Episode], whole: list[Tree]
) -> None:
    root = tmp_path / "d"
    _commit_all(root, episodes, [3])
    (root / "assets").mkdir()
    (root / "README.md").write_text("card")
    (root / "assets" / "events.png").write_bytes(b"png")
    with open_committer(root, _RUN, _SHARD, _agree) as committer:
        _seal(committer, episodes, [3, 4, 5])
        committer.commit()
    assert _tree(root) == {**whole[6], "README.md": b"card", "assets/events.png": b"png"}


@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.slow)])
def test_a_failed_operation_leaves_the_old_or_the_new_dataset(
    every: int,
    tmp_path: Path,
    episodes: list[Episode],
    whole: list[Tree],
    monkeypatch: pytest.MonkeyPatch,
    make_disk: Any,
) -> None:
    base = tmp_path / "base"
    _commit_all(base / "d", episodes, [3])
    failed = 0
    for n in range(1, 1000, every):
        root = tmp_path / str(n) / "d"
        shutil.copytree(base, root.parent)
        operations = _commit_with(make_disk(fail_at=n), root, episodes, monkeypatch)
        failed += operations >= n
        assert _tree(root) in (whole[3], whole[5])
        _commit_rest(root, episodes)
        assert _tree(root) == whole[6]
        assert [path.name for path in root.parent.iterdir()] == ["d"]
        shutil.rmtree(root.parent)
        if operations < n:
            break
    assert failed > 40 // every


def _commit_with(
    disk: Any, root: Path, episodes: list[Episode], monkeypatch: pytest.MonkeyPatch
) -> int:
    """Try to commit episodes 3 and 4; how many operations that took."""
    with open_committer(root, _RUN, _SHARD, _agree) as committer:
        _seal(committer, episodes, [3, 4])
        with monkeypatch.context() as patch:
            disk.install(patch)
            with suppress(OSError):
                committer.commit()
        verify_hashes(root)
    return disk.operations


def _commit_rest(root: Path, episodes: list[Episode]) -> None:
    with open_committer(root, _RUN, _SHARD, _agree) as committer:
        assert committer.missing(5) == []  # nothing sealed is ever lost
        _seal(committer, episodes, [5])
        committer.commit()


@pytest.mark.parametrize(
    "part", [0, 3, 6, *(pytest.param(part, marks=pytest.mark.slow) for part in (1, 2, 4, 5, 7))]
)
def test_a_full_disk_loses_no_episode(
    tmp_path: Path,
    episodes: list[Episode],
    whole: list[Tree],
    monkeypatch: pytest.MonkeyPatch,
    part: int,
    make_disk: Any,
) -> None:
    root = tmp_path / "d"
    _commit_all(root, episodes, [3])
    needed = sum(len(v) for k, v in whole[5].items() if whole[3].get(k) != v)
    room = needed * part // 8
    _commit_with(make_disk(room=room), root, episodes, monkeypatch)
    assert _tree(root) == whole[3]
    assert not (work_folder(root) / "next").exists()  # what did not fit has been removed
    _commit_rest(root, episodes)
    assert _tree(root) == whole[6]


def test_publish_without_exchange_uses_three_renames(
    tmp_path: Path,
    episodes: list[Episode],
    whole: list[Tree],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def unsupported(one: Path, other: Path) -> None:
        raise OSError(errno.EINVAL, "not here")

    monkeypatch.setattr(dataset_files, "exchange", unsupported)
    root = tmp_path / "d"
    _commit_all(root, episodes, [3, 3])
    assert _tree(root) == whole[6]


@pytest.mark.parametrize("crash_after", [1, 2])
def test_a_crash_between_the_renames_is_recovered(
    tmp_path: Path,
    episodes: list[Episode],
    whole: list[Tree],
    monkeypatch: pytest.MonkeyPatch,
    crash_after: int,
) -> None:
    root = tmp_path / "d"
    _commit_all(root, episodes, [3])
    with open_committer(root, _RUN, _SHARD, _agree) as committer, monkeypatch.context() as patch:
        _seal(committer, episodes, [3, 4])
        _crash_in_swap(patch, crash_after)
        with pytest.raises(KeyboardInterrupt):
            committer.commit()
    assert root.exists() == (crash_after == 2)
    with pytest.raises(UsageError, match="continue it with --resume") as caught:
        _commit_once(root)
    assert "remove that folder" not in str(caught.value)  # it may be the only copy
    _commit_rest(root, episodes)
    assert _tree(root) == whole[6]


def _crash_in_swap(patch: pytest.MonkeyPatch, after: int) -> None:
    rename, done = dataset_files.rename, 0

    def unsupported(one: Path, other: Path) -> None:
        raise OSError(errno.ENOSYS, "not here")

    def crashing(source: Path, target: Path) -> None:
        nonlocal done
        rename(source, target)
        done += 1
        if done == after:
            raise KeyboardInterrupt

    patch.setattr(dataset_files, "exchange", unsupported)
    patch.setattr(dataset_files, "rename", crashing)


def test_files_without_hard_links_are_copied(
    tmp_path: Path, episodes: list[Episode], whole: list[Tree], monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_links(source: Path, target: Path) -> None:
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", no_links)
    _commit_all(tmp_path / "d", episodes, [2, 4])
    assert _tree(tmp_path / "d") == whole[6]


def test_a_second_writer_is_refused_at_once(tmp_path: Path, episodes: list[Episode]) -> None:
    root = tmp_path / "d"
    with open_committer(root, _RUN, _SHARD):
        began = time.monotonic()
        with (
            pytest.raises(EnvironmentFailure, match=f"being written by process {os.getpid()}"),
            open_committer(root, _RUN, _SHARD, _agree),
        ):
            pass
        assert time.monotonic() - began < 1.0  # the issue's own bound, not a speed
    with open_committer(root, _RUN, _SHARD) as committer:
        _seal(committer, episodes, [0])
        committer.commit()


def test_a_folder_that_is_not_writable_is_refused() -> None:
    with (
        pytest.raises(EnvironmentFailure, match="cannot write beside /proc/dataset"),
        open_committer(Path("/proc/dataset"), _RUN),
    ):
        pass


def test_an_existing_dataset_needs_resume(tmp_path: Path, episodes: list[Episode]) -> None:
    root = tmp_path / "d"
    with open_committer(root, _RUN, _SHARD) as committer:
        _seal(committer, episodes, [1])
    with pytest.raises(UsageError, match="unfinished collection"), open_committer(root, _RUN):
        pass
    with open_committer(root, _RUN, _SHARD, _agree) as committer:
        _seal(committer, episodes, [0])
        committer.commit()
    with pytest.raises(UsageError, match="exists already; continue it with --resume"):
        _commit_once(root)


def _commit_once(root: Path) -> None:
    with open_committer(root, _RUN):
        pass


def test_a_refused_provenance_changes_nothing(tmp_path: Path, episodes: list[Episode]) -> None:
    root = tmp_path / "d"
    _commit_all(root, episodes, [3])
    with open_committer(root, _RUN, _SHARD, _agree) as committer:
        _seal(committer, episodes, [4])  # 3 is missing: it stays sealed
    before = _tree(tmp_path)

    def disagree(provenance: Provenance) -> None:
        raise UsageError("another seed")

    with (
        pytest.raises(UsageError, match="another seed"),
        open_committer(root, _RUN, _SHARD, disagree),
    ):
        pass
    assert _tree(tmp_path) == before
    with open_committer(root, _RUN, _SHARD, _agree) as committer:
        assert committer.staged == 1


def test_a_damaged_dataset_is_not_extended(tmp_path: Path, episodes: list[Episode]) -> None:
    root = tmp_path / "d"
    _commit_all(root, episodes, [3])
    path = root / "data/chunk-000/file-000.parquet"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with (
        pytest.raises(DataError, match=r"file-000\.parquet: damaged"),
        open_committer(root, _RUN, _SHARD, _agree),
    ):
        pass


def _kill_at_random_moments(folder: Path, times: int) -> None:
    """Kill a process that seals and commits; what it acknowledged must be there, whole."""
    root = folder / "d"
    script = Path(__file__).with_name("committing_process.py")
    for n in range(times):
        process = subprocess.Popen(
            [sys.executable, str(script), str(root)], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        for _ in range(1 + n * 7 % 13):  # some way into the run ...
            process.stdout.readline()
        time.sleep(n * 0.37 % 0.11)  # ... and then at any moment
        process.kill()
        said = [line.split() for line in process.communicate()[0].splitlines()]
        _require_acknowledged(root, [int(word[1]) for word in said if word[0] == "committed"])


def _require_acknowledged(root: Path, counts: list[int]) -> None:
    if root.exists():
        verify_hashes(root)
        reader = DatasetReader.open(DatasetConfig(root=str(root)))
        assert len(reader) >= max(counts, default=0)
        assert [reader.read(i).metadata["episode"] for i in range(len(reader))] == [
            *range(len(reader))
        ]
    else:
        assert not counts


@pytest.mark.slow
def test_kill_at_random_moments(tmp_path: Path) -> None:
    _kill_at_random_moments(tmp_path, 6)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_kill_at_two_hundred_random_moments(tmp_path: Path) -> None:
    _kill_at_random_moments(tmp_path, 200)


def _without(root: Path, episodes: Sequence[Episode], numbers: Sequence[int]) -> None:
    """A dataset of these episodes of a run, as `egovcp-dataset repair` writes it."""
    with DatasetWriter(root, _RUN, _SHARD) as writer:
        for number in numbers:
            writer.add(episodes[number])


@pytest.mark.parametrize(
    ("left", "added"),
    [([0, 2, 3], [4, 5]), ([0, 1, 3], [4, 5]), ([2], [3, 4, 5]), ([3, 0], [4, 5])],
)
@pytest.mark.parametrize("at_once", [True, False])
def test_resume_continues_after_the_highest_number(
    tmp_path: Path, episodes: list[Episode], left: list[int], added: list[int], at_once: bool
) -> None:
    root, expected = tmp_path / "d", tmp_path / "expected"
    _without(root, episodes, left)
    steps = [added] if at_once else [[number] for number in added]
    for numbers in steps:
        with open_committer(root, _RUN, _SHARD, _agree) as committer:
            count = committer.committed + len(numbers)
            assert committer.missing(count) == numbers
            _seal(committer, episodes, numbers)
            assert committer.missing(count) == []
            assert committer.commit() == numbers
            assert committer.committed == count
    _without(expected, episodes, [*left, *added])
    assert _tree(root) == _tree(expected)
    assert not list(dataset_problems(root))


def test_episodes_staged_before_a_removal_are_committed(
    tmp_path: Path, episodes: list[Episode]
) -> None:
    root = tmp_path / "d"
    _without(root, episodes, [0, 2])
    with open_committer(root, _RUN, _SHARD, _agree) as committer:
        _seal(committer, episodes, [4])
    with open_committer(root, _RUN, _SHARD, _agree) as committer:
        assert (committer.committed, committer.staged) == (2, 1)
        assert committer.missing(4) == [3]
        _seal(committer, episodes, [3])
        assert committer.commit() == [3, 4]


@pytest.mark.parametrize(
    ("facts", "error", "words"),
    [
        ({"seed": 0, "episode": 0}, DataError, "is number 0 of the collection, as episode"),
        ({"seed": 1, "episode": 1}, UsageError, "several collections and cannot be extended"),
        ({"seed": 0, "episode": 1.5}, DataError, "its number is 1.5, expected an integer"),
        ({"seed": 0, "episode": True}, DataError, "its number is True, expected an integer"),
    ],
)
def test_resume_refuses_episodes_that_it_cannot_continue(
    tmp_path: Path,
    episodes: list[Episode],
    facts: dict[str, Any],
    error: type[Exception],
    words: str,
) -> None:
    root = tmp_path / "d"
    with DatasetWriter(root, _RUN, _SHARD) as writer:
        writer.add(episodes[0])
        writer.add(replace(episodes[1], metadata=facts))
    before = _tree(root)
    with pytest.raises(error, match=words), open_committer(root, _RUN, _SHARD, _agree):
        pass
    assert _tree(root) == before
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


def test_resume_refuses_a_merged_dataset(tmp_path: Path, episodes: list[Episode]) -> None:
    sources = [{"controller_id": "stance-1", "seed": seed} for seed in range(2)]
    with DatasetWriter(tmp_path / "d", replace(_RUN, config={"sources": sources})) as writer:
        writer.add(episodes[0])
    with (
        pytest.raises(UsageError, match="several collections and cannot be extended"),
        open_committer(tmp_path / "d", _RUN, _SHARD, _agree),
    ):
        pass
