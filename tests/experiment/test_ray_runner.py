"""The same cells on a Ray cluster, a local one."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from egovcp.errors import EnvironmentFailure
from egovcp_experiment.cell import Cell, CellFigure, CellOutput
from egovcp_experiment.command import main
from egovcp_experiment.config import RayConfig
from egovcp_experiment.local_runner import INTERRUPTED, CellExit, versions
from egovcp_experiment.ray_runner import RayRun, RayRunner, RayTask
from egovcp_experiment.scheduler import CellScheduler
from egovcp_experiment.store import CellStore

from .conftest import MakeCell

ray = pytest.importorskip("ray")


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A temporary working directory and no running cluster."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.chdir(tmp_path)


def run(
    cells: Sequence[Cell],
    folder: Path,
    jobs: int = 2,
    config: RayConfig | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> CellScheduler:
    """Run cells on a cluster, or raise what running them raises."""
    store = CellStore(folder)
    runner = RayRunner(config or RayConfig(cpus=0.5), say)
    with store.locked(), closing(runner):
        schedule = CellScheduler(cells, store, jobs, say, runner)
        schedule.run()
    return schedule


@pytest.mark.slow
def test_cells_run_in_order_and_a_failure_stops_only_the_cells_that_need_it(
    here: None, cell: MakeCell, tmp_path: Path, diary: Path
) -> None:
    """The output folder is named relative to where the command was started."""
    cells = [
        cell("a", add=1),
        cell("b", add=2, source=CellOutput("a", "result.json")),
        cell("c", add=CellFigure("b", ("total",))),
        cell("broken", fail=3),
        cell("waits", source=CellOutput("broken", "result.json")),
    ]
    with pytest.raises(
        EnvironmentFailure, match=r"broken failed: the cause of it all.*broken\.log"
    ):
        run(cells, Path("out"))
    assert sorted(diary.read_text().split()) == ["a", "b", "broken", "c"]
    store = CellStore(Path("out"))
    records: dict[str, Any] = {}
    for one in cells[:3]:
        records[one.name] = store.load(one, records)
    assert [records[name]["figures"]["total"] for name in "abc"] == [1, 3, 3]
    assert records["c"]["hardware_cores"] == os.cpu_count()


@pytest.mark.slow
def test_an_interrupt_stops_running_and_queued_cells(
    here: None, cell: MakeCell, tmp_path: Path, diary: Path
) -> None:
    """Each takes all cores, so the second is queued. The first is resumed without a cluster."""
    lines: list[str] = []
    whole = RayConfig(cpus=float(os.cpu_count() or 1))

    def press() -> None:
        while not (tmp_path / "out" / "work" / "a" / "begun").exists():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=press, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        run([cell("a", wait=60), cell("b", wait=60)], tmp_path / "out", 2, whole, lines.append)
    assert {line.split(", ")[1].split(" after")[0] for line in lines[-2:]} == {
        "a: stopped",
        "b: stopped",
    }
    assert (tmp_path / "out" / "work" / "a" / "checkpoint").exists()
    assert diary.read_text().split() == ["a"]
    CellScheduler([cell("a", wait=0.01)], CellStore(tmp_path / "out")).run()
    assert diary.read_text().splitlines() == ["a ", "a true"]


def test_an_unreachable_cluster_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "nonsense://nowhere")
    out = tmp_path / "out"
    assert main(["planners", "--scale=smoke", f"--output_dir={out}", "--backend=ray"]) == 5
    assert "RAY_ADDRESS" in capsys.readouterr().err
    assert not list(out.glob("cells/*.json"))


@pytest.fixture
def task(tmp_path: Path) -> RayTask:
    log = tmp_path / "a.log"
    log.touch()
    return RayTask("quick_command", (), str(tmp_path), str(log), versions())


def test_a_node_without_the_folder_or_with_other_versions_is_refused(
    task: RayTask, tmp_path: Path
) -> None:
    task.check_node()
    older = {**task.versions, "torch": "1.0"}
    for changes, message in (
        ({"log": "/nowhere/logs/a.log"}, "/nowhere/logs/a.log; --output_dir must be on a file"),
        ({"versions": older}, "expected"),
        ({"folder": "/nowhere"}, "/nowhere"),
    ):
        with pytest.raises(EnvironmentFailure, match=message):
            replace(task, **changes).run()  # type: ignore[arg-type]
    assert (tmp_path / "a.log").read_bytes() == b""


class _RayError(Exception):
    """As `ray.exceptions.RayError`."""


class _RayTaskError(_RayError):
    """As `ray.exceptions.RayTaskError`."""

    def __init__(self, cause: Exception) -> None:
        self.cause = cause


class _TaskCancelledError(_RayError):
    """As `ray.exceptions.TaskCancelledError`."""


class _Ray:
    """The part of Ray that a run uses, with one task; ``answer`` is None while it runs."""

    exceptions = SimpleNamespace(
        RayError=_RayError, RayTaskError=_RayTaskError, TaskCancelledError=_TaskCancelledError
    )

    def __init__(self, answer: object = None) -> None:
        self.answer = answer

    def wait(self, tasks: list[object], timeout: float) -> tuple[list[object], list[object]]:
        return ([], tasks) if self.answer is None else (tasks, [])

    def get(self, task: object) -> object:
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def cancel(self, task: object, force: bool = False) -> None:
        self.answer = _TaskCancelledError()


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (_RayTaskError(EnvironmentFailure("node x has no folder")), "node x has no folder"),
        (_RayError("node died"), "its Ray worker or node is gone: node died"),
    ],
)
def test_a_task_that_cannot_run_or_is_lost_fails_its_cell(error: Exception, message: str) -> None:
    assert RayRun(_Ray(error), "task").ended() == CellExit(5, error=message)


def test_a_queued_task_is_cancelled_at_once() -> None:
    run = RayRun(_Ray(), "task")
    assert run.ended() is None
    run.interrupt()
    assert run.ended() == CellExit(INTERRUPTED)
