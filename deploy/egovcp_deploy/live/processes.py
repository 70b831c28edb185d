"""The control process of a run on the wall clock, with its watchdog."""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Final, NamedTuple

from egovcp.errors import EnvironmentFailure
from egovcp.log.async_sink import warn_on_stderr
from egovcp.workers import inherited_by_workers
from egovcp_deploy.live.control_process import control_process, damp_motors
from egovcp_deploy.live.hardware import RobotOptions
from egovcp_deploy.live.link import Link
from egovcp_deploy.robots.bridge import BridgeConfig, BridgeRobot

if TYPE_CHECKING:
    from egovcp_deploy.live.planner_loop import PlannerLoop

_END_S: Final = 5.0  # for a process to end by itself
_WATCHDOG_ROUNDS: Final = 20  # of damping commands, 50 ms each


class RunningControl(NamedTuple):
    """The control process of one run."""

    process: BaseProcess
    link: Link
    watchdog: DampingWatchdog

    def check_alive(self) -> None:
        """Raise `EnvironmentFailure` if the process has ended."""
        if not self.process.is_alive():
            raise EnvironmentFailure(
                f"the control process ended with code {self.process.exitcode}, see its message "
                "above; egovcp-deploy --dry_run=true checks robot and camera"
            )


@contextmanager
def running_control(options: RobotOptions) -> Iterator[RunningControl]:
    """Start the control process, its link and its watchdog; raises `EnvironmentFailure` if the
    robot does not answer."""
    with tempfile.TemporaryDirectory(prefix="egovcp-run-") as folder:
        address = f"ipc://{folder}/link"
        with (
            closing(Link(address, serve=True)) as link,
            standby_body(options.bridge) as body,
            _started(options, address) as process,
        ):
            watchdog = DampingWatchdog(process, body)
            try:
                yield RunningControl(process, link, watchdog)
            finally:
                watchdog.join_if_ended()


@contextmanager
def _started(options: RobotOptions, address: str) -> Iterator[BaseProcess]:
    """The process; terminated, then killed, when the context is left."""
    process = multiprocessing.get_context("spawn").Process(
        target=control_process, args=(options, address, os.getpid()), name="egovcp-control"
    )
    with inherited_by_workers():
        process.start()
    try:
        yield process
    finally:
        for end in (process.terminate, process.kill):
            if process.is_alive():
                end()
                process.join(_END_S)


def stop_control(process: BaseProcess, planner: PlannerLoop) -> None:
    """End the control process: wait for it if it has a quit command, then SIGTERM, on which it
    damps the motors too, then SIGKILL, after which the watchdog must damp them."""
    if planner.quitting:
        process.join(_END_S)
    if process.is_alive():
        planner.quitting = True
        process.terminate()
        process.join(_END_S)
    if process.is_alive():
        planner.quitting = False
        process.kill()
        process.join()


@contextmanager
def standby_body(config: BridgeConfig) -> Iterator[BridgeRobot]:
    """A second connection to the robot that only sends: damping needs the robot's mode and no
    further readings, so they are not decoded. Prints the robot's warning, if any, once."""
    with closing(BridgeRobot(config)) as body:
        body.connect()
        if body.warning:
            warn_on_stderr(f"egovcp-deploy: warning: {body.warning}")
        body.stop_receiving()
        yield body


class DampingWatchdog:
    """A thread that damps the robot over ``body``, a connection that nothing else uses, if the
    control process ends although ``expected()`` is false."""

    def __init__(self, process: BaseProcess, body: BridgeRobot) -> None:
        self._process, self._body = process, body
        self.expected: Callable[[], bool] = lambda: False
        self.acted = False  # whether the robot had to be damped from here
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        wait([self._process.sentinel])
        if not self.expected():
            self.acted = True
            for _ in range(_WATCHDOG_ROUNDS):
                damp_motors(self._body)

    def join_if_ended(self) -> None:
        """If the process has ended, wait until the robot is damped, where that is necessary."""
        if not self._process.is_alive():
            self._thread.join()
