"""`egovcp-collect`: simulation to LeRobot dataset."""

from __future__ import annotations

import importlib.metadata
import platform
import shlex
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial

import draccus

from egovcp.cli import run_command
from egovcp.data import DatasetWriter, Provenance
from egovcp.data.source import local_root
from egovcp.robot.controllers import make_controller
from egovcp.sim.env import decided
from egovcp_collect.config import CollectConfig
from egovcp_collect.progress import Progress
from egovcp_collect.workers import Shared, SimulationFailed, make_shared, run_groups

PROG = "egovcp-collect"
_PACKAGES = ("egovcp", "mujoco", "mjlab", "numpy", "lerobot")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = sys.argv[1:] if argv is None else list(argv)
    command = shlex.join([PROG, *args])
    return run_command(
        CollectConfig,
        partial(collect, command=command),
        args,
        prog=PROG,
        epilog="Ctrl-C keeps the episodes that are finished.",
    )


def collect(config: CollectConfig, command: str = "") -> None:
    """Simulate, write the dataset and print a summary.

    An interrupt, or an error of a worker, keeps the finished episodes and is then raised.

    Raises:
        UsageError: an option makes no sense, or the folder exists.
        KeyboardInterrupt: after SIGINT or SIGTERM.
    """
    config.check()
    config = replace(config, env=decided(config.env))
    writer = DatasetWriter(local_root(config.dataset), _provenance(config, command))
    try:
        with Progress(config.episodes) as progress:
            failure = _write_all(config, writer, progress)
    except BaseException:
        writer.discard()
        raise
    if writer.num_episodes:
        writer.finalize()
        print(progress.summary())
    else:
        writer.discard()
    if failure is not None:
        raise failure


def _write_all(
    config: CollectConfig, writer: DatasetWriter, progress: Progress
) -> BaseException | None:
    """Write episodes until all are there; what ended the simulation early, if anything did."""
    shared = make_shared()

    def refresh() -> None:
        progress.show(shared.steps.value)

    with _stop_on_signal(shared), closing(run_groups(config, shared, refresh)) as groups:
        while True:
            try:
                group = next(groups, None)
            except SimulationFailed as failed:
                return failed.__cause__
            if group is None:
                break
            for episode in group:
                writer.add(episode)
                progress.add(episode)
            refresh()
        return None if writer.num_episodes == config.episodes else KeyboardInterrupt()


@contextmanager
def _stop_on_signal(shared: Shared) -> Iterator[None]:
    """SIGINT and SIGTERM ask the workers to stop at their next tick."""

    def request(number: int, frame: object) -> None:
        shared.stop.value = 1

    previous = {s: signal.signal(s, request) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _provenance(config: CollectConfig, command: str) -> Provenance:
    controller = make_controller(config.env.controller)
    settings = draccus.encode(config)
    del settings["dataset"]
    return Provenance(
        controller_id=controller.id,
        seed=config.seed,
        command=command,
        versions={"python": platform.python_version(), **_versions()},
        config=settings,
    )


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in _PACKAGES}


if __name__ == "__main__":
    raise SystemExit(main())
