"""Runs cells as tasks of a Ray cluster (`egovcp.workers`).

The output folder and all paths in flags must be on a file system that every node has under the same
path. Every node needs this package, its commands, and the versions of this machine.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from egovcp.errors import EnvironmentFailure
from egovcp.workers import connect
from egovcp_experiment.local_runner import INTERRUPTED, CellExit, LocalProcess, versions

if TYPE_CHECKING:  # not imported on the nodes
    from egovcp_experiment.cell import CellCommand
    from egovcp_experiment.config import RayConfig

_DISTRIBUTION: Final = "egovcp-experiment"
_POLL_S: Final = 0.5


@dataclass(frozen=True)
class RayTask:
    """A command to run on any node."""

    module: str
    argv: tuple[str, ...]
    folder: str
    """Working directory; paths in the arguments may be relative to it."""
    log: str
    """Existing log file."""
    versions: Mapping[str, str]
    """Versions of the submitting machine."""

    def check_node(self) -> None:
        """Raise `EnvironmentFailure` if this node cannot run the command."""
        node = socket.gethostname()
        if not Path(self.log).is_file():
            raise EnvironmentFailure(
                f"node {node} has no {self.log}; --output_dir must be on a file system that all "
                "nodes share, under the same path"
            )
        if versions() != dict(self.versions):
            raise EnvironmentFailure(
                f"node {node} has {versions()}, expected {dict(self.versions)}; install these"
            )
        if not Path(self.folder).is_dir():
            raise EnvironmentFailure(f"node {node} has no {self.folder}, the working directory")

    def run(self) -> CellExit:
        """Run the command; Ray's cancellation interrupts it as Ctrl-C does."""
        self.check_node()
        process = LocalProcess(self.module, self.argv, Path(self.log), self.folder)
        while True:
            try:
                end = process.wait(_POLL_S)
            except KeyboardInterrupt:
                process.interrupt()
            else:
                if end is not None:
                    return end


class RayRun:
    """A submitted `RayTask`."""

    def __init__(self, ray: Any, result: Any) -> None:
        self._ray, self._result = ray, result

    def ended(self) -> CellExit | None:
        """How it ended, or None."""
        if not self._ray.wait([self._result], timeout=0)[0]:
            return None
        errors = self._ray.exceptions
        try:
            end: CellExit = self._ray.get(self._result)
        except errors.TaskCancelledError:
            return CellExit(INTERRUPTED)
        except errors.RayTaskError as error:
            return CellExit(EnvironmentFailure.exit_code, error=str(error.cause))
        except errors.RayError as error:
            lost = f"its Ray worker or node is gone: {error}"
            return CellExit(EnvironmentFailure.exit_code, error=lost)
        return end

    def interrupt(self) -> None:
        """Interrupt it as by Ctrl-C; a task that waits for free resources ends at once."""
        self._ray.cancel(self._result)

    def kill(self) -> None:
        """Kill its worker, which interrupts the command."""
        self._ray.cancel(self._result, force=True)


class RayRunner:
    """Runs commands on the cluster, wherever there are free resources.

    Raises:
        EnvironmentFailure: Ray is not installed, or the cluster cannot be reached.
    """

    def __init__(self, config: RayConfig, log: Callable[[str], None] = print) -> None:
        self._config = config
        self._ray = connect(_DISTRIBUTION)
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        if not any(
            node.get("CPU", 0.0) >= config.cpus and node.get("GPU", 0.0) >= config.gpus
            for node in nodes
        ):
            log(
                f"no node of the cluster has {config.cpus:g} CPUs and {config.gpus:g} GPUs "
                "(--ray.cpus, --ray.gpus) yet; cells wait until one joins"
            )

    def start(self, command: CellCommand, argv: Sequence[str], log: Path) -> RayRun:
        """Submit a command."""
        log.touch()
        task = RayTask(command.module, tuple(argv), os.getcwd(), str(log.absolute()), versions())
        remote = self._ray.remote(
            max_retries=0,
            num_cpus=self._config.cpus,
            num_gpus=self._config.gpus if command.uses_gpu else 0.0,
        )(RayTask.run)
        return RayRun(self._ray, remote.remote(task))

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()
