"""Workers that are actors of a Ray cluster; their staged episodes come back over the network.

Every node needs this package installed; no shared file system is needed.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Final

from egovcp.data.staging import StagedEpisode
from egovcp.sim.scenario import Scenario
from egovcp.workers import connect
from egovcp_collect.config import CollectConfig
from egovcp_collect.simulation import Simulation
from egovcp_collect.workers import Backend, Worker, WorkerReport, encode_episode, picklable

_LOG = logging.getLogger(__name__)
_REPORT_S: Final = 1.0  # each report is a round trip


class SimulationActor:
    """The class of the actors."""

    def __init__(self, config: CollectConfig) -> None:
        self._simulation = Simulation(config)

    def run(self, scenarios: Sequence[Scenario]) -> WorkerReport:
        """Queue episodes and simulate for `_REPORT_S`."""
        try:
            self._simulation.add(scenarios)
            steps, episodes = self._simulation.run(_REPORT_S)
            staged = tuple(
                StagedEpisode.of(number, encode_episode(number, episode))
                for number, episode in episodes
            )
        except Exception as error:  # noqa: BLE001 - every error is reported to the collection
            return WorkerReport(0, error=picklable(error))
        return WorkerReport(steps, tuple(number for number, _ in episodes), staged)


class RayWorker(Worker):
    """An actor with at most one pending call."""

    def __init__(self, ray: Any, config: CollectConfig) -> None:
        self._ray = ray
        self._actor = ray.remote(num_cpus=1)(SimulationActor).remote(config)
        self._queued: list[Scenario] = []
        self._unfinished = 0
        self.call: Any = None
        self._dead = False

    def assign(self, scenarios: Sequence[Scenario]) -> None:
        self._queued += scenarios
        self._unfinished += len(scenarios)
        if self.call is None:
            self._call()

    def poll(self) -> list[WorkerReport]:
        if self.call is None or not self._ray.wait([self.call], timeout=0)[0]:
            return []
        try:
            report: WorkerReport = self._ray.get(self.call)
        except self._ray.exceptions.RayError:  # the actor or its node is gone
            self.call, self._dead = None, True
            return []
        self._unfinished -= len(report.finished)
        self.call = None
        if self._unfinished:
            self._call()
        return [report]

    def _call(self) -> None:
        scenarios, self._queued = self._queued, []
        self.call = self._actor.run.remote(scenarios)

    @property
    def alive(self) -> bool:
        return not self._dead  # known only from a failed call

    def kill(self) -> None:
        self.call = None
        exceptions = (self._ray.exceptions.RayError, ConnectionError, RuntimeError, ValueError)
        try:
            self._ray.kill(self._actor)
        except exceptions as error:  # it must not hide why the worker is ended
            _LOG.warning("a Ray actor could not be ended: %s", error)


class RayBackend(Backend):
    """Connects to the cluster and starts actors.

    Raises:
        EnvironmentFailure: Ray is not installed, or the cluster cannot be reached.
    """

    def __init__(self, config: CollectConfig) -> None:
        self._ray = connect("egovcp-collect")
        self._config = config
        self._workers: list[RayWorker] = []

    @property
    def cores(self) -> int:
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def start(self) -> RayWorker:
        worker = RayWorker(self._ray, self._config)
        self._workers.append(worker)
        return worker

    def wait(self, seconds: float) -> None:
        calls = [worker.call for worker in self._workers if worker.call is not None]
        if calls:
            self._ray.wait(calls, timeout=seconds)

    def close(self) -> None:
        self._ray.shutdown()  # a cluster that was started here ends
