"""Cells on the nodes of a Ray cluster (`egovcp.workers`), each beside an actor that watches it.

Commands read and write files of each other and of the experiment, so the output folder, and all
that flags name, must be on a file system that every node has under the same path. Every node needs
this package, its commands, and the same versions as this machine.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from egovcp.errors import EnvironmentFailure
from egovcp.workers import connect
from egovcp_experiment.cell import Tool
from egovcp_experiment.config import RayConfig
from egovcp_experiment.local import LocalProcess, machine
from egovcp_experiment.runner import INTERRUPTED, Ended
from egovcp_experiment.store import versions

_LOG = logging.getLogger(__name__)
_DISTRIBUTION: Final = "egovcp-experiment"
_LOOK_EVERY: Final = 1.0  # s; each look is a round trip
_BEGINNING: Final = 0.5  # s; an actor that has room says sooner that it has begun
_FAREWELL: Final = 10.0  # s for a node to end a process


@dataclass(frozen=True)
class Order:
    """What a node is to run."""

    module: str
    argv: tuple[str, ...]
    folder: str
    """Current directory, to which paths in the arguments may be relative."""
    log: str
    """File that is there already, and takes what is printed."""
    versions: Mapping[str, str]
    """Package -> version, as on the machine that orders it."""


class RemoteCell:
    """What runs inside an actor."""

    def __init__(self) -> None:
        self._process: LocalProcess | None = None

    def start(self, order: Order) -> str:
        """Begin; why it cannot, or nothing."""
        here = socket.gethostname()
        if not Path(order.log).is_file():
            return (
                f"node {here} has no {order.log}; --output_dir must be on a file system that all "
                "nodes share, under the same path"
            )
        if versions() != dict(order.versions):
            return f"node {here} has {versions()}, expected {dict(order.versions)}; install these"
        try:
            os.chdir(order.folder)
        except OSError as error:
            return f"node {here} has no {order.folder} ({error.strerror}), where this was started"
        self._process = LocalProcess(order.module, order.argv, Path(order.log))
        return ""

    def watch(self, seconds: float) -> Ended | None:
        """How the command ended, if it does so within that time."""
        assert self._process is not None
        code = self._process.wait(seconds)
        # the machine is asked now, for that opens the GPU, which the command had to itself
        return None if code is None else Ended(code, machine())

    def interrupt(self) -> None:
        """As by Ctrl-C."""
        if self._process is not None:
            self._process.interrupt()

    def kill(self) -> None:
        """End the command and all that it has started."""
        if self._process is not None:
            self._process.kill()


class RayRun:
    """An actor with at most one call under way that an answer is needed to."""

    def __init__(self, ray: Any, actor: Any, order: Order) -> None:
        self._ray, self._actor = ray, actor
        self._call = actor.start.remote(order)
        self._begun = False
        self._end: Ended | None = None

    def ended(self) -> Ended | None:
        """How it ended, if it has.

        Raises:
            EnvironmentFailure: its node is gone, or cannot run it.
        """
        return self._ended(0.0)

    def _ended(self, within: float) -> Ended | None:
        if self._end is None and self._ray.wait([self._call], timeout=within)[0]:
            self._take(self._answer())
        return self._end

    def _answer(self) -> Any:
        try:
            return self._ray.get(self._call)
        except self._ray.exceptions.RayError as error:
            raise EnvironmentFailure(f"its Ray actor or node is gone: {error}") from error

    def _take(self, answer: Any) -> None:
        if not self._begun and answer:
            self._dismiss()
            raise EnvironmentFailure(answer)
        if self._begun and answer is not None:
            self._end = answer
            self._dismiss()
            return
        self._begun = True
        self._call = self._actor.watch.remote(_LOOK_EVERY)

    def interrupt(self) -> None:
        """As by Ctrl-C; what still waits for room on the cluster ends at once."""
        if not self._begun:
            with suppress(EnvironmentFailure):  # `ended` says it again
                self._ended(_BEGINNING)
        if self._begun:
            self._actor.interrupt.remote()
        else:
            self._dismiss()
            self._end = Ended(INTERRUPTED, {})

    def kill(self) -> None:
        """End it now, unless its node is out of reach."""
        try:
            if self._begun and self._end is None:
                self._ray.get(self._actor.kill.remote(), timeout=_FAREWELL)
        except self._ray.exceptions.RayError as error:
            _LOG.warning("a cell on the Ray cluster could not be ended: %s", error)
        self._dismiss()

    def _dismiss(self) -> None:
        """End the actor, which frees its share of the cluster; its command has ended, or ends with
        it."""
        try:
            self._ray.kill(self._actor)
        except (self._ray.exceptions.RayError, ConnectionError, RuntimeError, ValueError) as error:
            _LOG.warning("a Ray actor could not be ended: %s", error)


class RayRunner:
    """Joins the cluster and runs commands on it, wherever there is room.

    Args:
        config: what each command is given.
        say: is told if nothing can run for want of a large enough node.

    Raises:
        EnvironmentFailure: Ray is not installed, or the cluster cannot be reached.
    """

    def __init__(self, config: RayConfig, say: Callable[[str], None] = print) -> None:
        self._config = config
        self._ray = connect(_DISTRIBUTION)
        if not any(self._fits(node["Resources"]) for node in self._ray.nodes() if node["Alive"]):
            say(
                f"no node of the cluster has {config.cpus:g} CPUs and {config.gpus:g} GPUs "
                "(--ray.cpus, --ray.gpus) yet; cells wait until one joins"
            )

    def _fits(self, resources: Mapping[str, float]) -> bool:
        config = self._config
        return resources.get("CPU", 0.0) >= config.cpus and resources.get("GPU", 0.0) >= config.gpus

    def start(self, tool: Tool, argv: Sequence[str], log: Path) -> RayRun:
        """Run a command as soon as there is room for it."""
        log.touch()
        order = Order(tool.module, tuple(argv), os.getcwd(), str(log.absolute()), versions())
        share = {
            "num_cpus": self._config.cpus,
            "num_gpus": self._config.gpus if tool.learns else 0.0,
        }
        actor = self._ray.remote(max_restarts=0, **share)(RemoteCell).remote()
        return RayRun(self._ray, actor, order)

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()
