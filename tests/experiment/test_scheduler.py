"""Cells run once, in order and in parallel; failed and stopped cells continue later."""

from __future__ import annotations

import hashlib
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from egovcp.errors import DataError, EnvironmentFailure, UsageError
from egovcp_experiment.cell import COLLECT, Cell, CellMetric, CellOutput, ExternalPath
from egovcp_experiment.local_runner import CellProcess, commit
from egovcp_experiment.scheduler import CellScheduler
from egovcp_experiment.store import CellStore

from .conftest import MakeCell


def run(
    cells: Sequence[Cell],
    folder: Path,
    jobs: int = 1,
    say: Callable[[str], None] = lambda line: None,
) -> CellScheduler:
    """Run cells, or raise what running them raises."""
    store = CellStore(folder)
    with store.locked():
        schedule = CellScheduler(cells, store, jobs, say)
        schedule.run()
    return schedule


def chain(cell: MakeCell) -> list[Cell]:
    """a, then b from a file of a, then c from a metric of b."""
    b = cell("b", add=2, source=CellOutput("a", "result.json"))
    return [cell("a", add=1), b, cell("c", add=CellMetric("b", ("total",)))]


def test_cells_read_files_and_metrics_of_other_cells(cell: MakeCell, tmp_path: Path) -> None:
    records = run(chain(cell), tmp_path / "out").records
    assert [records[name]["metrics"]["total"] for name in "abc"] == [1, 3, 3]
    assert records["b"]["settings"]["flags"]["source"]["sha256"] == records["a"]["sha256"]
    assert str(tmp_path / "out" / "work" / "a" / "result.json") in records["b"]["command"]


def test_a_finished_cell_is_never_run_again(cell: MakeCell, tmp_path: Path, diary: Path) -> None:
    first = run(chain(cell), tmp_path / "out").records
    again = run([*chain(cell), cell("d", add=1)], tmp_path / "out").records
    assert diary.read_text().split() == ["a", "b", "c", "d"]
    assert {name: again[name] for name in first} == first


def test_other_settings_are_refused_before_anything_runs(
    cell: MakeCell, tmp_path: Path, diary: Path
) -> None:
    run([cell("a", add=1)], tmp_path / "out")
    with pytest.raises(UsageError, match=r"flags\.add was 1, is 2; name another --output_dir"):
        run([cell("new"), cell("a", add=2)], tmp_path / "out")
    assert diary.read_text().split() == ["a"]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"settings": {}}', '{"settings": 1}'])
def test_a_damaged_result_is_refused(cell: MakeCell, tmp_path: Path, text: str) -> None:
    run([cell("a", add=1)], tmp_path / "out")
    (tmp_path / "out" / "cells" / "a.json").write_text(text)
    with pytest.raises(DataError, match=r"a\.json is damaged: .*; remove it to run its cell again"):
        run([cell("a", add=1)], tmp_path / "out")


def test_other_content_of_a_given_file_is_refused(cell: MakeCell, tmp_path: Path) -> None:
    file = tmp_path / "given.json"
    file.write_text('{"total": 4}')
    cells = [cell("a", source=ExternalPath(str(file)))]
    assert run(cells, tmp_path / "out").records["a"]["metrics"]["total"] == 4
    run(cells, tmp_path / "out")
    file.write_text('{"total": 5}')
    with pytest.raises(UsageError, match=r"flags\.source\.sha256 was"):
        run(cells, tmp_path / "out")


def test_a_result_is_tied_to_the_files_that_its_cell_has_read(
    cell: MakeCell, tmp_path: Path, diary: Path
) -> None:
    """The diary changes during the run."""
    diary.touch()
    cells = [cell("a", read=ExternalPath(str(diary)))]
    found = run(cells, tmp_path / "out").records["a"]["settings"]["flags"]["read"]
    assert found == {"sha256": hashlib.sha256().hexdigest()}
    with pytest.raises(UsageError, match=r"flags\.read\.sha256 was"):
        run(cells, tmp_path / "out")


def test_a_failure_stops_only_the_cells_that_need_it(
    cell: MakeCell, tmp_path: Path, diary: Path
) -> None:
    broken, alone = cell("a", fail=3), cell("d", add=1)
    with pytest.raises(EnvironmentFailure, match=r"cell a failed: the cause of it all.*a\.log"):
        run([broken, *chain(cell)[1:], alone], tmp_path / "out")
    assert diary.read_text().split() == ["a", "d"]
    run([*chain(cell), alone], tmp_path / "out")
    assert diary.read_text().split() == ["a", "d", "a", "b", "c"]


def test_the_time_that_is_left_is_estimated(cell: MakeCell, tmp_path: Path) -> None:
    """By the estimates, then by how long complete cells took for theirs."""
    cells = [cell("a", hours=2), cell("b", hours=3), cell("c", hours=1)]
    store = CellStore(tmp_path / "out")
    schedule = CellScheduler(cells, store, 1, lambda line: None)
    assert schedule.outlook == "3 to go, about 6.0 h"
    two = CellScheduler(cells, store, 2, lambda line: None)
    assert two.outlook == "3 to go, about 6.0 h"  # cells share the cores
    store.records["a"] = {"minutes": 30.0}
    assert schedule.outlook == "2 to go, about 60 min"
    assert two.outlook == "2 to go, about 30 min"
    lines: list[str] = []
    run([cell("d", hours=1), cell("e", hours=1)], tmp_path / "other", say=lines.append)
    assert lines[0].endswith("d: begins; 2 to go, about 2.0 h")
    assert lines[-1].endswith("; all done")


def test_independent_cells_run_in_parallel(cell: MakeCell, tmp_path: Path) -> None:
    """Each of two waits until it is interrupted: both have begun only if they run together."""
    cells = [cell("a", wait=60), cell("b", wait=60)]
    with pytest.raises(KeyboardInterrupt):
        interrupted(cells, tmp_path / "out", jobs=2)


def test_exclusive_cells_run_alone_and_last(cell: MakeCell, tmp_path: Path) -> None:
    shared = cell("t", wait=0.3)
    timing = replace(shared, command=replace(shared.command, exclusive=True))
    other = replace(timing, name="u")
    after = cell("c", add=CellMetric("u", ("total",)))
    lines: list[str] = []
    cells = [timing, other, cell("a", wait=0.5), cell("b", wait=0.1), after]
    run(cells, tmp_path / "out", jobs=3, say=lines.append)
    told = [line.partition(", ")[2] for line in lines]
    order = [f"{t.partition(':')[0]} {t.partition(': ')[2].split()[0]}" for t in told]
    assert order[:2] == ["a begins;", "b begins;"]
    assert sorted(order[2:4]) == ["a done", "b done"]
    assert order[4:8] == ["t begins;", "t done", "u begins;", "u done"]
    assert order[8:] == ["c begins;", "c done"]


def test_an_exclusive_cell_has_all_cores(
    cell: MakeCell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shares = {}

    def start(cell: Cell, argv: Sequence[str], log: Path, slot: int, jobs: int) -> CellProcess:
        shares[cell.name] = jobs
        return CellProcess(cell, argv, log, slot, jobs)

    monkeypatch.setattr("egovcp_experiment.scheduler.CellProcess", start)
    shared = cell("a")
    timing = Cell("t", replace(shared.command, exclusive=True), extra=shared.extra)
    run([shared, timing], tmp_path / "out", jobs=2)
    assert shares == {"a": 2, "t": 1}


def test_a_collection_without_a_complete_shard_is_resumed(tmp_path: Path) -> None:
    """Its episodes are staged beside the folder, which does not exist yet."""
    assert "--resume=true" in CellStore(tmp_path).prepare(Cell("collect", COLLECT))


def test_an_interrupted_cell_is_resumed(cell: MakeCell, tmp_path: Path, diary: Path) -> None:
    out = tmp_path / "out"
    lines: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        interrupted([cell("a", wait=60)], out, say=lines.append)
    assert "a: stopped after" in lines[-1]
    assert (out / "work" / "a" / "checkpoint").exists()
    assert not (out / "cells" / "a.json").exists()
    run([cell("a", wait=0.01)], out)
    assert diary.read_text().splitlines() == ["a ", "a true"]


def interrupted(cells: Sequence[Cell], folder: Path, jobs: int = 1, **options: Any) -> None:
    """Run cells, and interrupt this process when all of them have begun."""

    def press() -> None:
        while not all((folder / "work" / c.name / "begun").exists() for c in cells):
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=press, daemon=True).start()
    run(cells, folder, jobs, **options)


def test_output_without_a_checkpoint_is_removed(cell: MakeCell, tmp_path: Path) -> None:
    rest = tmp_path / "out" / "work" / "a" / "torn"
    (tmp_path / "out" / "cells").mkdir(parents=True)
    rest.mkdir(parents=True)
    run([cell("a", add=1)], tmp_path / "out")
    assert not rest.exists()


def test_the_folder_is_locked(tmp_path: Path) -> None:
    with (
        CellStore(tmp_path / "out").locked(),
        pytest.raises(EnvironmentFailure, match="is being written by process"),
        CellStore(tmp_path / "out").locked(),
    ):
        pass


def test_a_folder_with_other_content_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("do not touch")
    with (
        pytest.raises(UsageError, match="something other than experiments"),
        CellStore(tmp_path).locked(),
    ):
        pass


def test_the_commit_of_a_checkout_is_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    root = Path(__file__).parents[2]
    if (root / ".git").exists():
        assert re.fullmatch(r"[0-9a-f]{7,40}\+?", commit())
    monkeypatch.setenv("PATH", "")
    assert commit() == ""
