"""For tests: time for a fake robot, and patience for what comes over a wire."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from egovcp_deploy.robots.bridge import BridgeConfig
from egovcp_deploy.robots.fake.bridge import FakeBridge

PATIENCE_S = 120.0


def eventually(condition: Callable[[], bool], patience: float = PATIENCE_S) -> bool:
    """Whether it becomes true before patience, s, ends."""
    deadline = time.monotonic() + patience
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True


class Running:
    """Lets time pass for a fake robot, in a thread, a little slower than on the clock."""

    def __init__(self, fake: FakeBridge) -> None:
        self.fake = fake
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.005):
            self.fake.step()

    def stop(self) -> None:
        """Let no more time pass."""
        self._stop.set()
        self._thread.join()


def config_of(fake: FakeBridge, mode: int | None = None) -> BridgeConfig:
    """Where ``fake`` listens."""
    ports = fake.ports
    return BridgeConfig(ports.host, ports.state_port, ports.command_port, mode)
