"""The same cells on a Ray cluster, a local one."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from egovcp.errors import EnvironmentFailure
from egovcp_experiment.cell import Cell, Found, Output
from egovcp_experiment.cluster import Order, RayRun, RayRunner, RemoteCell
from egovcp_experiment.command import main
from egovcp_experiment.config import RayConfig
from egovcp_experiment.runner import INTERRUPTED
from egovcp_experiment.schedule import Schedule
from egovcp_experiment.store import Store, versions

from .conftest import MakeCell

ray = pytest.importorskip("ray")


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No cluster but the one that a test starts itself, in a folder of its own."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.chdir(tmp_path)


def run(
    cells: Sequence[Cell],
    folder: Path,
    jobs: int = 2,
    config: RayConfig | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Schedule:
    """Run cells on a cluster, or raise what running them raises."""
    store = Store(folder)
    runner = RayRunner(config or RayConfig(cpus=0.5), say)
    with store.locked(), closing(runner):
        schedule = Schedule(cells, store, jobs, say, runner)
        schedule.run()
    return schedule


def test_cells_run_after_those_they_need_and_a_failure_stops_no_others(
    here: None, cell: MakeCell, tmp_path: Path, diary: Path
) -> None:
    """The output folder is named relative to where the command was started."""
    cells = [
        cell("a", add=1),
        cell("b", add=2, source=Output("a", "result.json")),
        cell("c", add=Found("b", ("total",))),
        cell("broken", fail=3),
        cell("waits", source=Output("broken", "result.json")),
    ]
    with pytest.raises(
        EnvironmentFailure, match=r"broken failed: the cause of it all.*broken\.log"
    ):
        run(cells, Path("out"))
    assert sorted(diary.read_text().split()) == ["a", "b", "broken", "c"]
    store = Store(Path("out"))
    records: dict[str, Any] = {}
    for one in cells[:3]:
        records[one.name] = store.kept(one, records)
    assert [records[name]["figures"]["total"] for name in "abc"] == [1, 3, 3]
    assert records["c"]["hardware_cores"] == os.cpu_count()


def test_an_interrupt_stops_what_runs_and_what_waits_for_room(
    here: None, cell: MakeCell, tmp_path: Path, diary: Path
) -> None:
    """Each takes all cores, so the second has none. The first goes on here, without a cluster."""
    said: list[str] = []
    whole = RayConfig(cpus=float(os.cpu_count() or 1))

    def press() -> None:
        while not (tmp_path / "out" / "work" / "a" / "begun").exists():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=press, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        run([cell("a", wait=60), cell("b", wait=60)], tmp_path / "out", 2, whole, said.append)
    assert {line.split(", ")[1].split(" after")[0] for line in said[-2:]} == {
        "a: stopped",
        "b: stopped",
    }
    assert (tmp_path / "out" / "work" / "a" / "checkpoint").exists()
    assert diary.read_text().split() == ["a"]
    Schedule([cell("a", wait=0.01)], Store(tmp_path / "out")).run()
    assert diary.read_text().splitlines() == ["a ", "a true"]


def test_a_cluster_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "nonsense://nowhere")
    out = tmp_path / "out"
    assert main(["planners", "--scale=smoke", f"--output_dir={out}", "--backend=ray"]) == 5
    assert "RAY_ADDRESS" in capsys.readouterr().err
    assert not list(out.glob("cells/*.json"))


@pytest.fixture
def order(tmp_path: Path) -> Order:
    log = tmp_path / "a.log"
    log.touch()
    return Order("quick_command", (), str(tmp_path), str(log), versions())


def test_a_node_without_the_folder_or_with_other_versions_says_so(
    order: Order, tmp_path: Path
) -> None:
    elsewhere = replace(order, log="/nowhere/logs/a.log")
    assert "/nowhere/logs/a.log; --output_dir must be on a file system" in (
        RemoteCell().start(elsewhere)
    )
    older = replace(order, versions={**order.versions, "torch": "1.0"})
    assert "expected" in RemoteCell().start(older)
    assert "/nowhere" in RemoteCell().start(replace(order, folder="/nowhere"))
    assert (tmp_path / "a.log").read_bytes() == b""


class _Call:
    """A call whose answer is there, or not yet."""

    def __init__(self, answer: Any = None, there: bool = True) -> None:
        self.answer, self.there = answer, there


class _Lost(Exception):
    """As `ray.exceptions.RayError`."""


class _Ray:
    """As much of Ray as a run uses, with one actor."""

    exceptions = SimpleNamespace(RayError=_Lost)

    def __init__(self, *answers: _Call) -> None:
        self._answers: Iterator[_Call] = iter(answers)
        self.killed = 0
        self.asked: list[str] = []

    def __getattr__(self, name: str) -> Any:
        def remote(*args: object) -> _Call:
            self.asked.append(name)
            return next(self._answers) if name in ("start", "watch") else _Call()

        return SimpleNamespace(remote=remote)

    def wait(self, calls: list[_Call], timeout: float) -> tuple[list[_Call], list[_Call]]:
        there = [call for call in calls if call.there]
        return there, [call for call in calls if not call.there]

    def get(self, call: _Call, timeout: float | None = None) -> Any:
        if isinstance(call.answer, Exception):
            raise call.answer
        return call.answer

    def kill(self, actor: object) -> None:
        self.killed += 1


def started(order: Order, *answers: _Call) -> tuple[RayRun, _Ray]:
    fake = _Ray(*answers)
    return RayRun(fake, fake, order), fake


def test_a_node_that_cannot_run_a_cell_fails_it_and_frees_its_room(order: Order) -> None:
    made, fake = started(order, _Call("node x has no folder"))
    with pytest.raises(EnvironmentFailure, match="node x has no folder"):
        made.ended()
    assert fake.killed == 1


def test_a_node_that_is_lost_fails_its_cell(order: Order) -> None:
    made, _ = started(order, _Call(_Lost("node died")))
    with pytest.raises(EnvironmentFailure, match="gone: node died"):
        made.ended()


def test_a_cell_that_waits_for_room_is_stopped_at_once(order: Order) -> None:
    made, fake = started(order, _Call(there=False))
    assert made.ended() is None
    made.interrupt()
    end = made.ended()
    assert end is not None
    assert (end.code, fake.killed, fake.asked) == (INTERRUPTED, 1, ["start"])
