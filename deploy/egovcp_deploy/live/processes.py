"""The control process of a run on the wall clock, with its watchdog."""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from ctypes import c_bool
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Final, NamedTuple

from egovcp.errors import EnvironmentFailure
from egovcp.log.async_sink import warn_on_stderr
from egovcp.workers import inherited_by_workers
from egovcp_deploy.live.control_process import control_process, damp_motors
from egovcp_deploy.live.hardware import RobotOptions
from egovcp_deploy.live.link import Link
from egovcp_deploy.robots.bridge import BridgeConfig, BridgeRobot

_END_S: Final = 5.0  # for a process to end by itself
_INTERRUPTED_END_S: Final = 0.5  # the same after another Ctrl-C
_SLICE_S: Final = 0.05
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
    """Start the control process, its link and its watchdog, and end it with `stop_control`; raises
    `EnvironmentFailure` if the robot does not answer."""
    with tempfile.TemporaryDirectory(prefix="egovcp-run-") as folder:
        address = f"ipc://{folder}/link"
        with (
            closing(Link(address, serve=True)) as link,
            standby_body(options.bridge) as body,
        ):
            context = multiprocessing.get_context("spawn")
            commanded = context.RawValue(c_bool, False)  # no lock: neither process waits for it
            process = context.Process(
                target=control_process,
                args=(options, address, os.getpid(), commanded),
                name="egovcp-control",
                daemon=True,  # the exit of this process sends it SIGTERM, on which it damps
            )
            with inherited_by_workers():
                process.start()
            watchdog = DampingWatchdog(process, body, lambda: commanded.value)
            try:
                yield RunningControl(process, link, watchdog)
            finally:
                stop_control(process, watchdog)


def stop_control(
    process: BaseProcess, watchdog: DampingWatchdog, interrupts: Sequence[int] = ()
) -> None:
    """End the control process: wait for it if it has a quit command, then SIGTERM, on which it
    damps the motors too, then SIGKILL, after which ``watchdog`` damps them. A SIGINT that is added
    to ``interrupts`` shortens the waits."""
    if watchdog.expected():
        _join(process, interrupts)
    if process.is_alive():
        watchdog.expected = lambda: True
        process.terminate()
        _join(process, interrupts)
    if process.is_alive():
        watchdog.expected = lambda: False
        process.kill()
        process.join(_END_S)
    watchdog.join_if_ended()


def _join(process: BaseProcess, interrupts: Sequence[int]) -> None:
    waits = round(_END_S / _SLICE_S)
    while waits > 0 and process.is_alive():
        process.join(_SLICE_S)
        waits = min(waits - 1, round(_INTERRUPTED_END_S / _SLICE_S)) if interrupts else waits - 1


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
    control process ends although ``expected()`` is false. If it does not send motor commands
    (``commanded()`` is false), the robot is not ours to damp."""

    def __init__(
        self,
        process: BaseProcess,
        body: BridgeRobot,
        commanded: Callable[[], bool],
    ) -> None:
        self._process, self._body, self._commanded = process, body, commanded
        self.expected: Callable[[], bool] = lambda: False  # whether a quit command was sent
        self.acted = False  # whether the robot had to be damped from here
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        wait([self._process.sentinel])
        if self._commanded() and not self.expected():
            self.acted = True
            for _ in range(_WATCHDOG_ROUNDS):
                damp_motors(self._body)

    def join_if_ended(self) -> None:
        """If the process has ended, wait until the robot is damped, where that is necessary."""
        if not self._process.is_alive():
            self._thread.join()
