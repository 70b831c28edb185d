"""`egovcp-collect`: simulate episodes and write them as a LeRobot dataset."""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

from egovcp.cli import preset_defaults, run_command
from egovcp.data import DatasetConfig
from egovcp.data.committer import Committer, open_committer
from egovcp.data.episode import frame_bytes
from egovcp.data.source import local_root
from egovcp.errors import DataError, EnvironmentFailure
from egovcp.hardware import available_cores
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import resolve_config
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.registry import find_task
from egovcp.terminal import echo
from egovcp.workers import stop_on_signal
from egovcp_collect.config import PRESETS, CollectConfig
from egovcp_collect.provenance import make_provenance, require_compatible
from egovcp_collect.worker_pool import Worker, WorkerPool

PROG: Final = "egovcp-collect"
_EPILOG: Final = (
    "Every episode is written to disk as soon as it ends. After an interruption the same command "
    "with --resume continues; with more --episodes it extends the dataset."
)
MIN_COMPRESSED_SHARE: Final = 0.2
"""Lower bound of the compressed size of a frame as a share of `frame_bytes`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = sys.argv[1:] if argv is None else list(argv)
    command = shlex.join([PROG, *args])
    return run_command(
        CollectConfig,
        partial(collect, command=command),
        args,
        prog=PROG,
        epilog=_EPILOG,
        defaults=partial(preset_defaults, PRESETS),
    )


def collect(config: CollectConfig, command: str = "") -> None:
    """Simulate the missing episodes, commit them shard by shard, and print a summary.

    If it ends early, finished episodes are kept: the dataset holds them up to the first one that is
    missing, and the others stay staged on the disk for --resume.

    Raises:
        UsageError: an option is invalid, or the destination exists.
        DataError: the existing data or a staged episode are damaged, or the simulation diverged.
        EnvironmentFailure: another process writes the dataset, there is too little disk space, or
            workers die repeatedly.
        OSError: the disk is full.
        KeyboardInterrupt: after SIGINT or SIGTERM.
    """
    config.check()
    config = replace(config, env=resolve_config(config.env, config.tasks))
    provenance = make_provenance(config, command)
    check_existing = partial(require_compatible, provenance) if config.resume else None
    root = local_root(DatasetConfig(config.dataset.repo_id, config.dataset.root))
    with open_committer(root, provenance, config.shard_episodes, check_existing) as committer:
        missing = _missing_scenarios(config, committer)
        if committer.committed > config.episodes:
            echo(
                f"{root} has {committer.committed} episodes, more than --episodes="
                f"{config.episodes}; none is removed; `egovcp-dataset delete` can do that"
            )
        if missing:
            require_disk_space(committer.root.parent, missing, config.env, config.shard_episodes)
        began = time.monotonic()
        with tqdm(
            total=config.episodes,
            initial=committer.committed + committer.staged,
            unit="ep",
            smoothing=0.1,
            mininterval=0.5 if sys.stderr.isatty() else 10,
        ) as bar:
            try:
                steps, stopped = _simulate(config, missing, committer, bar)
            except BaseException as error:
                _commit_after(error, committer)
                raise
            committer.commit()
        rate = steps / (time.monotonic() - began)
        waiting = f", {committer.staged} more staged for --resume" if committer.staged else ""
        echo(
            f"{committer.committed} episodes, {committer.frames} steps, {rate:.0f} steps/s{waiting}"
        )
        if stopped and committer.committed < config.episodes:
            echo(f"{PROG}: run the same command with --resume to continue", error=True)
            raise KeyboardInterrupt
        if committer.committed < config.episodes:  # the first missing one stopped the commit
            raise DataError(
                f"the staged file of episode {committer.next_number} was damaged on the disk or "
                "removed; run the same command with --resume to simulate it again"
            )


def _commit_after(error: BaseException, committer: Committer) -> None:
    """Commit the staged episodes; a second error becomes a note of the first."""
    try:
        committer.commit()
    except Exception as second:  # noqa: BLE001 - it must not hide the first error
        text = f"staged episodes could not be committed, --resume will do it: {second}"
        error.add_note(text)
        echo(f"{PROG}: warning: {text}", error=True)


def _missing_scenarios(config: CollectConfig, committer: Committer) -> list[Scenario]:
    """The episodes that are neither committed nor staged."""
    numbers = set(committer.missing(config.episodes))
    through = replace(config, episodes=max(numbers, default=0) + 1)
    return [scenario for scenario in through.scenarios() if scenario.episode in numbers]


def min_bytes(scenarios: Sequence[Scenario], env: EnvConfig, shard_episodes: int) -> int:
    """Lower bound of the bytes that the episodes take, with one shard of them uncompressed."""
    ticks = [env.episode(scenario.task).ticks for scenario in scenarios]
    uncompressed, share = sum(ticks[:shard_episodes]), MIN_COMPRESSED_SHARE
    frame = frame_bytes(find_task(scenarios[0].task).robot_spec())
    return round(frame * (share * sum(ticks) + (1 - share) * uncompressed))


def require_disk_space(
    folder: Path, scenarios: Sequence[Scenario], env: EnvConfig, shard_episodes: int
) -> None:
    """Raise `EnvironmentFailure` if the file system of ``folder`` has less than `min_bytes`."""
    needed = min_bytes(scenarios, env, shard_episodes)
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise EnvironmentFailure(
            f"{len(scenarios)} episodes need at least {needed / 1e9:.1f} GB below {folder}, where "
            f"{free / 1e9:.1f} GB are free; free disk space, reduce --episodes, or choose another "
            "--dataset.root"
        )


def _simulate(
    config: CollectConfig, scenarios: Sequence[Scenario], committer: Committer, bar: Any
) -> tuple[int, bool]:
    """Simulate until every episode is staged or a stop signal arrives.

    Returns the simulated planner ticks, summed over the robots, and whether a signal arrived.
    """
    if not scenarios:
        return 0, False
    start = partial(Worker, config, committer.staging.folder)
    count = config.num_workers or available_cores()
    pool = WorkerPool(start, count, scenarios, config.num_envs, config.worker_timeout)
    steps, began = 0, time.monotonic()
    with stop_on_signal() as stopped, closing(pool):
        while not pool.done and not stopped:
            for report in pool.poll():
                for number in report.finished:
                    committer.mark_staged(number)
                steps += report.steps
                bar.update(len(report.finished))
            rate = steps / (time.monotonic() - began)
            bar.set_postfix_str(f"{rate:.0f} steps/s", refresh=False)
            bar.update(0)
            if committer.next_shard_is_complete:
                committer.commit()
        return steps, bool(stopped)


if __name__ == "__main__":
    raise SystemExit(main())
