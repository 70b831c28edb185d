"""Injects every fault many times into the fake G1 over ZMQ, on loaded cores; prints reaction times.

Prints a row per kind; docs/robot.md summarises them. Fails (exit code 1) if a reaction is not the
required one, or if the 99th percentile of the time to DAMP of any kind with a DAMP deadline is
above 250 ms. After Ctrl-C the runs so far are summed up (exit code 130, or 1 if one had a problem).
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from report import parser, publish

from egovcp.entry_point import INTERRUPTED
from egovcp.hardware import available_cores
from egovcp_deploy.live.control_process import raise_priority

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for tests.support

from tests.support.robots.fault_kinds import FAULTS, FaultKind, Reaction
from tests.support.robots.fault_rig import FaultRig
from tests.support.robots.fault_runs import (
    DAMP_LIMIT_MS,
    FaultRun,
    markdown,
    percentile,
    run_fault,
)

RIG_PRIORITY = 5
NON_DAMP_INTERVAL = 4  # run faults without a DAMP deadline only in every 4th repetition


def busy_loop(parent: int) -> None:
    """Occupy a core until killed, or until the parent process has ended."""
    while os.getppid() == parent:
        sum(range(10000))


@contextmanager
def cpu_load(processes: int) -> Iterator[None]:
    """Run ``processes`` busy processes during the measurement."""
    context = multiprocessing.get_context("spawn")
    busy = [
        context.Process(target=busy_loop, args=(os.getpid(),), daemon=True)
        for _ in range(processes)
    ]
    for process in busy:
        process.start()
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.join()


def run_all(kinds: Sequence[FaultKind], repetitions: int) -> tuple[list[FaultRun], bool]:
    """All faults in turn, ``repetitions`` times; those without a DAMP deadline less often.

    Returns:
        the runs; whether Ctrl-C ended them early.
    """
    rows, interrupted = list[FaultRun](), False
    rig = FaultRig()
    try:
        for repetition in range(repetitions):
            for kind in kinds:
                if kind.reaction is not Reaction.DAMP and repetition % NON_DAMP_INTERVAL:
                    continue
                row = run_fault(rig, kind)
                rows.append(row)
                if row.problem:
                    print(f"{kind.name}: {row.problem}", file=sys.stderr, flush=True)
            print(f"{repetition + 1} of {repetitions}", file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        interrupted = True
        print(f"interrupted: {len(rows)} runs are summed up", file=sys.stderr)
    finally:
        rig.close()
    return rows, interrupted


def damp_p99(rows: Sequence[FaultRun]) -> dict[str, float | None]:
    """Kind -> 99th percentile of the time to DAMP, ms; None: never damped."""
    names = dict.fromkeys(row.kind.name for row in rows)
    return {
        name: percentile([row.damped_ms for row in rows if row.kind.name == name], 99)
        for name in names
    }


def metrics(rows: Sequence[FaultRun], p99: dict[str, float | None]) -> dict[str, object]:
    """Metrics in one flat dict: per kind, and over all runs."""
    out: dict[str, object] = {"kinds": len({row.kind.name for row in rows}), "runs": len(rows)}
    for name in p99:
        same = [row for row in rows if row.kind.name == name]
        key = "".join(c if c.isalnum() else "_" for c in name)
        out[f"{key}_ends"] = ",".join(sorted({row.end for row in same}))
        out[f"{key}_hold_ms_p50"] = percentile([row.held_ms for row in same], 50)
        out[f"{key}_damp_ms_p50"] = percentile([row.damped_ms for row in same], 50)
        out[f"{key}_damp_ms_p99"] = p99[name]
        out[f"{key}_max_change_rad"] = max(row.max_change for row in same)
    timed = [row.damped_ms for row in rows if row.kind.reaction is Reaction.DAMP]
    out["all_damp_ms_p50"] = percentile(timed, 50)
    out["all_damp_ms_p99"] = percentile(timed, 99)
    out["all_damp_ms_max"] = percentile(timed, 100)
    out["invalid_commands"] = sum(row.invalid for row in rows)
    out["problems"] = sum(bool(row.problem) for row in rows)
    return out


def over_limit(rows: Sequence[FaultRun], p99: dict[str, float | None]) -> list[str]:
    """Kinds with a DAMP deadline whose ``p99`` (`damp_p99`) exceeds the limit."""
    late = []
    for name in dict.fromkeys(r.kind.name for r in rows if r.kind.reaction is Reaction.DAMP):
        ms = p99[name]
        if ms is not None and ms > DAMP_LIMIT_MS:
            late.append(f"{name}: {ms:.0f} ms")
    return late


def main() -> None:
    p = parser(__doc__, rounds=None)
    p.add_argument(
        "--repetitions",
        type=int,
        default=20,
        help="runs of each kind with a DAMP deadline; a quarter as many of the others",
    )
    p.add_argument("--only", default="", help="kinds whose name contains this")
    p.add_argument(
        "--load", type=int, default=available_cores(), help="busy processes during the measurement"
    )
    p.add_argument("--markdown", type=Path, help="also write the table to this file")
    args = p.parse_args()
    kinds = [kind for kind in FAULTS if args.only in kind.name]
    if not kinds:
        names = ", ".join(kind.name for kind in FAULTS)
        p.error(f"--only={args.only}: no kind has this in its name; kinds: {names}")
    with cpu_load(args.load):
        # Raise the simulator's priority so that the reaction time excludes its scheduling delay.
        raise_priority(RIG_PRIORITY)
        rows, interrupted = run_all(kinds, args.repetitions)
    table = markdown(rows)
    print(table)
    if args.markdown is not None:
        args.markdown.write_text(table, encoding="utf-8")
    p99 = damp_p99(rows)
    publish(metrics(rows, p99) | {"load_processes": args.load}, args.json)
    late = over_limit(rows, p99)
    problems = [f"{row.kind.name}: {row.problem}" for row in rows if row.problem]
    for line in [*problems, *late]:
        print(f"problem: {line}", file=sys.stderr)
    if problems or late:
        sys.exit(1)
    if interrupted:
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
