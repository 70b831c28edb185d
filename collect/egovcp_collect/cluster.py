"""Workers as actors of a Ray cluster (`egovcp.workers`); their episodes come back sealed.

Every node needs this package, and nothing of this machine's disk.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Final

from egovcp.data.staging import StagedEpisode
from egovcp.sim.scenario import Scenario
from egovcp.workers import connect, ray_package
from egovcp_collect.backend import Brief, Report, encode_numbered, portable
from egovcp_collect.config import CollectConfig
from egovcp_collect.simulation import Simulation

_LOG = logging.getLogger(__name__)
_DISTRIBUTION: Final = "egovcp-collect"
_REPORT_EVERY: Final = 1.0  # s; each report is a round trip


def _ray() -> Any:
    """The package, which only this backend needs."""
    return ray_package(_DISTRIBUTION)


class RemoteSimulation:
    """What runs inside an actor."""

    def __init__(self, config: CollectConfig) -> None:
        self._simulation = Simulation(config)

    def advance(self, scenarios: Sequence[Scenario]) -> Report:
        """Play for a while, these episodes too."""
        try:
            self._simulation.add(scenarios)
            progress = self._simulation.advance(_REPORT_EVERY)
            encoded = [(n, encode_numbered(n, e)) for n, e in progress.episodes]
        except Exception as error:  # noqa: BLE001 - whatever it is, the collection must hear of it
            return Report(0, failure=portable(error))
        briefs = tuple(Brief.of(number, episode) for number, episode in encoded)
        sealed = tuple(StagedEpisode.of(number, episode) for number, episode in encoded)
        return Report(progress.steps, briefs, sealed)


class RayWorker:
    """An actor with at most one call under way."""

    def __init__(self, config: CollectConfig) -> None:
        self._actor = _ray().remote(num_cpus=1)(RemoteSimulation).remote(config)
        self._queued: list[Scenario] = []
        self._unfinished = 0
        self.call: Any = None
        self._dead = False

    def give(self, scenarios: Sequence[Scenario]) -> None:
        """More episodes, with the next call."""
        self._queued += scenarios
        self._unfinished += len(scenarios)
        if self.call is None:
            self._advance()

    def reports(self) -> list[Report]:
        """The answer to the call, if it has come; the next call goes out at once."""
        if self.call is None or not _ray().wait([self.call], timeout=0)[0]:
            return []
        try:
            report: Report = _ray().get(self.call)
        except _ray().exceptions.RayError:  # the actor or its node is gone
            self.call, self._dead = None, True
            return []
        self._unfinished -= len(report.done)
        self.call = None
        if self._unfinished:
            self._advance()
        return [report]

    def _advance(self) -> None:
        scenarios, self._queued = self._queued, []
        self.call = self._actor.advance.remote(scenarios)

    @property
    def alive(self) -> bool:
        """False once a call has failed; Ray tells no earlier."""
        return not self._dead

    def kill(self) -> None:
        """End the actor; one that cannot be reached any more is as good as ended.

        Work goes on, or ends for another reason, which must not be hidden by this.
        """
        self.call = None
        try:
            _ray().kill(self._actor)
        except (_ray().exceptions.RayError, ConnectionError, RuntimeError, ValueError) as error:
            _LOG.warning("a Ray actor could not be ended: %s", error)


class RayBackend:
    """Connects to the cluster and starts actors.

    Raises:
        EnvironmentFailure: Ray is not installed, or the cluster cannot be reached.
    """

    def __init__(self, config: CollectConfig) -> None:
        connect(_DISTRIBUTION)
        self._config = config
        self._workers: list[RayWorker] = []

    @property
    def cores(self) -> int:
        """Processor cores of the cluster."""
        return max(1, int(_ray().cluster_resources().get("CPU", 1)))

    def start(self) -> RayWorker:
        """A new actor, somewhere."""
        worker = RayWorker(self._config)
        self._workers.append(worker)
        return worker

    def wait(self, seconds: float) -> None:
        """Until a call has been answered."""
        calls = [worker.call for worker in self._workers if worker.call is not None]
        if calls:
            _ray().wait(calls, timeout=seconds)

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        _ray().shutdown()
