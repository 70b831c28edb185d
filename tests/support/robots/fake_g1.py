"""Runs a fake G1 in a thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from egovcp_deploy.robots.bridge import BridgeConfig
from egovcp_deploy.robots.fake import FakeBridge

TIMEOUT_S = 120.0


def eventually(condition: Callable[[], bool], timeout: float = TIMEOUT_S) -> bool:
    """Whether ``condition`` becomes true within ``timeout`` s."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True


class FakeG1Thread:
    """Steps a fake G1 in a thread, a little slower than in real time."""

    def __init__(self, fake: FakeBridge) -> None:
        self.fake = fake
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.005):
            self.fake.step()

    def stop(self) -> None:
        """Stop stepping."""
        self._stop.set()
        self._thread.join()


def bridge_config(fake: FakeBridge, mode: int | None = None) -> BridgeConfig:
    """Connection options for ``fake``."""
    ports = fake.ports
    return BridgeConfig(ports.host, ports.state_port, ports.command_port, mode)
