"""Time that logging adds to a tick: in the loop, on a thread, and in a separate process.

The loop plans with a small model, whose many short operations are sensitive to the interpreter
lock, then writes a complete tick to an MCAP file and to Rerun.

    none          no log
    inline        the sinks are called by the loop
    thread        a queue and a thread
    process       `AsyncFanout`
    stalled_disk  the same; the process that writes the MCAP file is stopped
    dead_viewer   the same; the Rerun viewer was killed

``cpu`` metrics are the CPU time of the loop's thread while it writes. Part of `tick.py`: run
`python benchmarks/tick.py --parts logging`.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from egovcp.log.async_sink import AsyncFanout, AsyncSink
from egovcp.log.mcap import McapSink
from egovcp.log.rerun import RerunSink
from egovcp.log.tick import Candidates, Fanout, RunInfo, Sink, Tick
from egovcp.log.viewer import LOOPBACK, LiveRerun, Viewer
from egovcp.plan import PlannerConfig, ReferenceEvaluator, make_plan, optimiser_of
from egovcp.spec import ACTION_DIM, PLANNER_DT, PLANNER_HZ, STATE_DIM
from egovcp.testing import toy_model
from tests.support.ports import free_port

_INFO = RunInfo("ball")
_PAUSE_S = 0.2  # between two cases, to write queued ticks


class NoLog:
    """No log."""

    def open(self, info: RunInfo) -> None: ...

    def write(self, tick: Tick) -> None: ...

    def close(self) -> None: ...


class Threaded:
    """A queue and a thread."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._queue: queue.Queue[Tick | None] = queue.Queue(300)
        self._thread = threading.Thread(target=self._work)

    def open(self, info: RunInfo) -> None:
        self._sink.open(info)
        self._thread.start()

    def write(self, tick: Tick) -> None:
        self._queue.put_nowait(tick)

    def close(self) -> None:
        self._queue.put(None)
        self._thread.join()
        self._sink.close()

    def _work(self) -> None:
        while (tick := self._queue.get()) is not None:
            self._sink.write(tick)


def logging_metrics(rounds: int) -> dict[str, object]:
    """Percentiles of each case over ``rounds`` seconds; differences and ratios to ``none``."""
    torch.set_num_threads(1)
    with contextlib.ExitStack() as stack:
        cases = {name: stack.enter_context(case) for name, case in _cases(stack).items()}
        spent = _measure(cases, rounds)
    metrics: dict[str, object] = {"seconds_per_case": rounds}
    for name, times in spent.items():
        metrics |= percentiles(f"tick_{name}", times.tick)
        metrics |= percentiles(f"write_{name}", times.write)
        metrics |= percentiles(f"write_{name}_cpu", times.write_cpu)
    for name in spent:
        if name != "none":
            base, own = spent["none"].tick, spent[name].tick
            for q in (50, 99):
                without, with_log = np.percentile(base, q), np.percentile(own, q)
                metrics[f"logging_{name}_added_ms_p{q}"] = float(1e3 * (with_log - without))
            metrics[f"logging_{name}_ratio"] = float(np.median(own) / np.median(base))
    return metrics


def percentiles(name: str, seconds: list[float]) -> dict[str, object]:
    """p50 and p99 in ms."""
    return {f"{name}_ms_p{q}": float(1e3 * np.percentile(seconds, q)) for q in (50, 99)}


@dataclass(frozen=True)
class _Times:
    """Seconds, one per tick."""

    tick: list[float] = field(default_factory=list)
    write: list[float] = field(default_factory=list)
    write_cpu: list[float] = field(default_factory=list)


def _measure(cases: dict[str, Sink], rounds: int) -> dict[str, _Times]:
    """Case -> what its ticks took."""
    work, tick = _planning(), _tick()
    spent = {name: _Times() for name in cases}
    index = 0
    for _ in range(rounds):
        for name, sink in cases.items():
            time.sleep(_PAUSE_S)
            for _ in range(PLANNER_HZ):
                begin = time.perf_counter()
                work()
                planned, cpu = time.perf_counter(), time.thread_time()
                sink.write(replace(tick, index=index, time_ns=round(1e9 * index * PLANNER_DT)))
                end = time.perf_counter()
                index += 1
                spent[name].write_cpu.append(time.thread_time() - cpu)
                spent[name].tick.append(end - begin)
                spent[name].write.append(end - planned)
                time.sleep(max(0.0, PLANNER_DT - (end - begin)))
    return spent


def _planning() -> Callable[[], object]:
    model = toy_model()
    config = PlannerConfig(samples=64, elites=16)
    carry, executed = model.initial(1), torch.zeros(1, ACTION_DIM)
    evaluator = ReferenceEvaluator(model, config)

    def plan() -> object:
        with torch.no_grad():
            generator = torch.Generator().manual_seed(0)
            return make_plan(evaluator, optimiser_of(config), carry, executed, config, generator)

    return plan


def _tick() -> Tick:
    """A tick with everything that a run with a world model logs."""
    rng = np.random.default_rng(0)
    images = np.linspace(0.5, 4.5, 48 * 64).reshape(48, 64) + rng.normal(0, 0.01, (17, 48, 64))
    state = rng.normal(0, 0.1, STATE_DIM).astype(np.float32)
    state[3:6] = (0.0, 0.0, -1.0)
    return Tick(
        index=0,
        time_ns=0,
        depth=(1000 * images[0]).astype(np.uint16),
        state=state,
        action_planned=np.zeros(ACTION_DIM, np.float32),
        action_sent=np.zeros(ACTION_DIM, np.float32),
        depth_reconstructed=images[0].astype(np.float32),
        depth_imagined=images[1:].astype(np.float32),
        plan=np.zeros((4, ACTION_DIM), np.float32),
        candidates=Candidates(rng.uniform(0, 0.5, (32, 4, 2, 3)), rng.normal(size=32)),
        value=1.0,
        termination=0.01,
        reward_terms={"block": 0.0, "hit": 0.0, "fall": 0.0, "pose": -0.005},
        timing_ms={"observe": 1.0, "plan": 20.0, "decode": 5.0, "robot": 3.0},
        base=np.array([0.0, 0.0, 0.74, 1.0, 0.0, 0.0, 0.0]),
    )


def _cases(stack: contextlib.ExitStack) -> dict[str, contextlib.AbstractContextManager[Sink]]:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))

    def pair(name: str) -> tuple[Sink, Sink]:
        return McapSink(folder / f"{name}.mcap"), RerunSink(folder / f"{name}.rrd")

    return {
        "none": _opened(NoLog()),
        "inline": _opened(Fanout(pair("inline"))),
        "thread": _opened(Threaded(Fanout(pair("thread")))),
        "process": _opened(_fanout(*pair("process"))),
        "stalled_disk": _stalled(*pair("stalled")),
        "dead_viewer": _dead(McapSink(folder / "dead.mcap")),
    }


def _fanout(mcap: Sink, rerun: Sink) -> AsyncFanout:
    sinks = {"MCAP": mcap, "Rerun": rerun}
    return AsyncFanout(
        [AsyncSink(s, n, close_timeout_s=2.0, warn=lambda line: None) for n, s in sinks.items()]
    )


@contextlib.contextmanager
def _opened(sink: Sink) -> Iterator[Sink]:
    sink.open(_INFO)
    try:
        yield sink
    finally:
        sink.close()


@contextlib.contextmanager
def _stalled(mcap: Sink, rerun: Sink) -> Iterator[Sink]:
    with _opened(fanout := _fanout(mcap, rerun)):
        os.kill(fanout.sinks[0].pid, signal.SIGSTOP)
        yield fanout


@contextlib.contextmanager
def _dead(mcap: Sink) -> Iterator[Sink]:
    viewer = Viewer(f"rerun+http://{LOOPBACK}:{free_port()}/proxy")
    with (
        LiveRerun("web", viewer, free_port()) as live,
        _opened(_fanout(mcap, RerunSink(live.viewer))) as sink,
    ):
        assert live.pid is not None
        os.kill(live.pid, signal.SIGKILL)
        yield sink
