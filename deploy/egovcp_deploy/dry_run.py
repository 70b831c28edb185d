"""`egovcp-deploy --dry_run=true`: is all there that a run needs? Go or no-go, line by line."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from egovcp.errors import EgovcpError, EnvironmentFailure
from egovcp.plan import blank_observation, until
from egovcp_deploy.pilot.effort import BUDGET_S
from egovcp_deploy.policy import RolloutPolicy, backend_of

FREE_BYTES: Final = 1_000_000_000  # an hour of recording is about 0.6 GB
PLAN_BUDGET_MS: Final = 36.0
_PLANS: Final = 50
_WARM_UP: Final = 5
_PLANNING_S: Final = 5.0  # a slow machine is told so sooner
_DISK_BYTES: Final = 4_000_000
_DISK_MS: Final = 200.0


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    name: str
    found: str
    error: EgovcpError | None = None
    """What speaks against a run; None: nothing."""

    def __str__(self) -> str:
        if self.error is None:
            return f"go     {self.name}: {self.found}"
        return f"NO-GO  {self.name}: {self.error}"


def examine(name: str, look: Callable[[], str]) -> Finding:
    """What ``look`` finds, or the error that it raises."""
    try:
        return Finding(name, look())
    except EgovcpError as error:
        return Finding(name, "", error)


def conclude(findings: Iterator[Finding], say: Callable[[str], None] = print) -> None:
    """Say each finding as it comes, then go, or raise the first error.

    Raises:
        EgovcpError: of the first finding that speaks against a run.
    """
    errors = []
    for finding in findings:
        say(str(finding))
        if finding.error is not None:
            errors.append(finding.error)
    if errors:
        say(f"no-go: {len(errors)} of the above")
        raise errors[0]
    say("go")


def disk(folder: Path) -> str:
    """Room for a recording, and how fast it is written.

    Raises:
        EnvironmentFailure: too little room, or too slow.
    """
    existing = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    free = shutil.disk_usage(existing).free
    if free < FREE_BYTES:
        raise EnvironmentFailure(
            f"{free / 1e9:.1f} GB free at {existing}, expected {FREE_BYTES / 1e9:.0f} GB; "
            "make room, or choose another --output_dir"
        )
    ms = _write_ms(existing)
    if ms > _DISK_MS:
        raise EnvironmentFailure(
            f"writing {_DISK_BYTES / 1e6:.0f} MB to {existing} took {ms:.0f} ms, expected at most "
            f"{_DISK_MS:.0f}; choose another --output_dir"
        )
    return f"{free / 1e9:.0f} GB free, {_DISK_BYTES / 1e3 / max(ms, 1e-3):.0f} MB/s"


def _write_ms(folder: Path) -> float:
    trial = folder / f".egovcp-dry-run-{os.getpid()}"
    begin = time.perf_counter()
    try:
        with trial.open("wb") as file:
            file.write(os.urandom(_DISK_BYTES))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise EnvironmentFailure(f"cannot write to {folder}: {error.strerror}") from error
    finally:
        trial.unlink(missing_ok=True)
    return (time.perf_counter() - begin) * 1e3


def plan_time(policy: RolloutPolicy) -> str:
    """How long a plan takes here, on a made-up observation.

    Raises:
        EnvironmentFailure: too long for 25 Hz.
    """
    depth, state = blank_observation(1)
    policy.reset()
    times, iterations = list[float](), list[int]()
    end = time.monotonic() + _PLANNING_S
    while len(times) < _WARM_UP + _PLANS and (time.monotonic() < end or len(times) <= _WARM_UP):
        begin = time.perf_counter()
        step = policy.act(depth, state, until(begin + BUDGET_S))
        times.append((time.perf_counter() - begin) * 1e3)
        iterations.append(step.iterations)
    policy.reset()
    p50, p99 = np.percentile(times[_WARM_UP:], [50, 99])
    if p99 > PLAN_BUDGET_MS:
        raise EnvironmentFailure(
            f"a plan of one iteration takes {p50:.0f} ms (p99 {p99:.0f}), computed by "
            f"{backend_of(policy)}, expected at most {PLAN_BUDGET_MS:.0f} at 25 Hz; end other "
            "programs, or use fewer --planner.samples"
        )
    mean = np.mean(iterations[_WARM_UP:])
    return (
        f"{p50:.1f} ms per plan, p99 {p99:.1f}, with {mean:.1f} iterations, computed by "
        f"{backend_of(policy)}"
    )
