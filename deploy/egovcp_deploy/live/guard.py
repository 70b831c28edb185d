"""Watches over the control process: if it dies, its robot is damped from here."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Final

from egovcp.log.async_sink import warn_on_stderr
from egovcp_deploy.live.process import last_words
from egovcp_deploy.robots.base import LowLevelRobot
from egovcp_deploy.robots.bridge import BridgeConfig, BridgeRobot

_ROUNDS: Final = 20  # of last words, 50 ms each


@contextmanager
def spare_body(config: BridgeConfig) -> Iterator[BridgeRobot]:
    """A second connection to the robot that only speaks: 500 states a second are not decoded for
    a few last words, which need the robot's mode and no more. What the operator should know of the
    robot is printed once.

    Raises:
        EnvironmentFailure: the robot does not answer.
    """
    body = BridgeRobot(config)
    body.connect()
    try:
        if body.warning:
            warn_on_stderr(f"egovcp-deploy: warning: {body.warning}")
        body.stop_receiving()
        yield body
    finally:
        body.close()


class Guard:
    """A thread that sleeps until the control process ends.

    Args:
        process: the control process.
        body: a second connection to the robot, used for nothing else.
        wanted: whether the process is supposed to end.
    """

    def __init__(
        self, process: BaseProcess, body: LowLevelRobot, wanted: Callable[[], bool]
    ) -> None:
        self._process, self._body, self._wanted = process, body, wanted
        self.acted = False
        """Whether the robot had to be damped from here."""
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        wait([self._process.sentinel])
        if not self._wanted():
            self.acted = True
            for _ in range(_ROUNDS):
                last_words(self._body)

    def join(self) -> None:
        """Wait until nothing is left to do; the process has ended."""
        self._thread.join()

    def join_if_acting(self) -> None:
        """Wait until a robot that has to be damped from here has been."""
        if not self._process.is_alive():  # the thread may not have noticed yet
            self.join()
