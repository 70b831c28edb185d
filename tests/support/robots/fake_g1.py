"""Runs a fake G1 in a thread."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress

from egovcp_deploy.robots.bridge import BridgeConfig
from egovcp_deploy.robots.fake import FakeBridge

TIMEOUT_S = 120.0


def eventually(condition: Callable[[], bool], timeout: float = TIMEOUT_S) -> bool:
    """Whether ``condition`` becomes true within ``timeout`` s.

    It takes at most a fifth of the time, as it may read a whole recording.
    """
    deadline = time.monotonic() + timeout
    while True:
        begin = time.monotonic()
        if condition():
            return True
        end = time.monotonic()
        if end > deadline:
            return False
        time.sleep(max(0.002, 4 * (end - begin)))


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


@contextmanager
def raised_priority(level: int) -> Iterator[None]:
    """Threads started in this context inherit real-time priority ``level``, if it is granted; the
    calling thread gets its own priority back."""
    with ExitStack() as stack:
        with suppress(AttributeError, OSError):
            policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(level))
            stack.callback(os.sched_setscheduler, 0, policy, parameter)
        yield
