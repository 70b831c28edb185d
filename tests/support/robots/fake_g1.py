"""Runs a fake G1 in a thread, or `egovcp-fake-g1` in a process."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass

from egovcp_deploy.robots.bridge import BridgeConfig
from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports

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


@dataclass(frozen=True)
class FakeG1Process:
    """A running `egovcp-fake-g1`, and where it listens."""

    program: subprocess.Popen[str]
    ports: Ports


@contextmanager
def fake_g1_process(*flags: str) -> Iterator[FakeG1Process]:
    """`egovcp-fake-g1` at free ports, which listens; killed when the context is left."""
    free = ("--ports.command_port=0", "--ports.state_port=0", "--ports.camera_port=0")
    command = [sys.executable, "-m", "egovcp_deploy.robots.fake.command", *free, *flags]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as program:
        assert program.stdout is not None
        try:
            begin = program.stdout.readline()
            while begin and "listening" not in begin:
                begin = program.stdout.readline()
            found = re.search(r"on (\S+): commands (\d+), states (\d+), depth (\d+);", begin)
            assert found, "it does not listen"
            host, *ports = found.groups()
            yield FakeG1Process(program, Ports(host, *map(int, ports)))
        finally:
            program.kill()


def bridge_config(fake: FakeBridge | FakeG1Process, mode: int | None = None) -> BridgeConfig:
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
