"""`egovcp-collect`: simulation to LeRobot dataset."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import draccus

from egovcp.cli import run_command
from egovcp.data import Provenance
from egovcp.data.committer import Committer, open_committer
from egovcp.data.source import local_root
from egovcp.packages import require_packages
from egovcp.robot.controllers import make_controller
from egovcp.sim.env import resolve_config
from egovcp.sim.scenario import Scenario
from egovcp.terminal import echo
from egovcp.workers import stop_on_signal
from egovcp_collect.backend import Backend
from egovcp_collect.config import SHAPING, CollectConfig
from egovcp_collect.crew import Crew
from egovcp_collect.progress import Progress
from egovcp_collect.resume import require_same
from egovcp_collect.room import require_room
from egovcp_collect.versions import installed_versions

PROG: Final = "egovcp-collect"
_EPILOG: Final = (
    "Every finished episode is safe on the disk at once. Whatever ends the command, the same "
    "command with --resume goes on from there; with more --episodes it extends a dataset."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = sys.argv[1:] if argv is None else list(argv)
    command = shlex.join([PROG, *args])
    return run_command(
        CollectConfig, partial(collect, command=command), args, prog=PROG, epilog=_EPILOG
    )


def collect(config: CollectConfig, command: str = "") -> None:
    """Simulate what is missing, commit it shard by shard, and print a summary.

    Whatever ends it early, every finished episode is sealed, and those that follow each other from
    the first are in the dataset.

    Raises:
        UsageError: an option makes no sense, or something is there already.
        DataError: what is there is damaged, or the simulation diverged.
        EnvironmentFailure: another process writes the dataset; there is not enough room for it;
            workers cannot be kept alive.
        OSError: the disk is full.
        KeyboardInterrupt: after SIGINT or SIGTERM.
    """
    config.check()
    if config.backend == "ray":
        require_packages("egovcp-collect", "--backend=ray", "ray")
    config = replace(config, env=resolve_config(config.env))
    provenance = _provenance(config, command)
    agree = partial(require_same, provenance) if config.resume else None
    root = local_root(config.dataset)
    with open_committer(root, provenance, config.shard_episodes, agree) as committer:
        missing = _missing(config, committer)
        require_room(committer.root.parent, missing, config.env, config.shard_episodes)
        already = committer.committed + committer.staged
        with Progress(config.episodes, already, lambda: _disk_bytes(committer)) as progress:
            try:
                _collect(config, missing, committer, progress)
            except BaseException as error:
                _commit_after(error, committer)
                raise
            committer.commit()
        echo(_summary(committer, progress))
        if committer.committed < config.episodes:
            raise KeyboardInterrupt


def _commit_after(error: BaseException, committer: Committer) -> None:
    """Commit what is sealed; should that fail, too, the user still hears of ``error``."""
    try:
        committer.commit()
    except Exception as second:  # noqa: BLE001 - whatever it is, it came after, and from, the first
        words = f"what is sealed could not be committed, --resume will do it: {second}"
        error.add_note(words)
        echo(f"{PROG}: warning: {words}", error=True)


def _missing(config: CollectConfig, committer: Committer) -> list[Scenario]:
    """The episodes that are neither committed nor sealed."""
    numbers = set(committer.missing(config.episodes))
    through = replace(config, episodes=max(numbers, default=0) + 1)
    return [scenario for scenario in through.scenarios() if scenario.episode in numbers]


def _collect(
    config: CollectConfig, scenarios: Sequence[Scenario], committer: Committer, progress: Progress
) -> None:
    """Until every episode is sealed, or a signal asks to stop."""
    if not scenarios:
        return
    backend = _backend(config, committer)
    workers = config.num_workers or backend.cores
    with (
        stop_on_signal() as stopped,
        Crew(backend, workers, scenarios, config.num_envs, config.worker_timeout) as crew,
    ):
        while not crew.over and not stopped:
            for report in crew.poll():
                for sealed in report.sealed:
                    sealed.verify()
                    committer.staging.put(sealed)
                for brief in report.done:
                    committer.mark_staged(brief.number)
                progress.add(report)
            progress.show()
            if committer.next_shard_is_complete:
                committer.commit()


def _backend(config: CollectConfig, committer: Committer) -> Backend:
    if config.backend == "ray":
        from egovcp_collect.cluster import RayBackend

        return RayBackend(config)
    from egovcp_collect.local import LocalBackend

    return LocalBackend(config, committer.staging.folder)


def _disk_bytes(committer: Committer) -> int:
    files = committer.root.glob("data/*/*.parquet")
    return committer.staging.size() + sum(file.stat().st_size for file in files)


def _summary(committer: Committer, progress: Progress) -> str:
    """The last line of the command."""
    waiting = f", {committer.staged} more sealed for --resume" if committer.staged else ""
    return (
        f"{committer.committed} episodes, {committer.frames} steps, {progress.rate:.0f} steps/s"
        f"{waiting}"
    )


def _provenance(config: CollectConfig, command: str) -> Provenance:
    settings = draccus.encode(config)
    return Provenance(
        controller_id=make_controller(config.env.controller).id,
        seed=config.seed,
        command=command,
        versions=installed_versions(),
        config={name: settings[name] for name in SHAPING},
    )


if __name__ == "__main__":
    raise SystemExit(main())
