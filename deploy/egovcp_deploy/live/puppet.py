"""A G1 whose planner is somebody else's program: observations out, actions in.

The control process of `egovcp-deploy` does the rest, with the same state machine and limits: it
stands the robot up, holds it when actions stop coming, damps it when it must.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure, SafetyStop, UsageError
from egovcp.plan import PolicyStep
from egovcp.spec import ACTION_DIM, ACTION_RATE_LIMIT
from egovcp_deploy.live.guard import Guard, spare_body
from egovcp_deploy.live.link import Link, Order, decode_report, encode_order, encode_reply
from egovcp_deploy.live.operators import EASE_S, Auto, Operator
from egovcp_deploy.live.run import LiveSetup, started
from egovcp_deploy.live.run_folder import run_folder
from egovcp_deploy.pilot.desk import Reply, Report
from egovcp_deploy.pilot.states import Request, State

Array = NDArray[np.float64]

_START_S: Final = 60.0  # for the control process to come up
_STAND_S: Final = 60.0  # for the robot to stand, on somebody's word
_NEWS_S: Final = 0.5  # longest wait for an observation; they come every 40 ms
_END_S: Final = 5.0
_KEPT: Final = 4  # ticks for which the last action is a plan, should the next be late


class Puppet:
    """One robot, from `connect` to `close`.

    Args:
        setup: which robot, and how carefully it is driven.
        operator: who says when to stand, arm and run; None: whoever holds its remote control.
    """

    def __init__(self, setup: LiveSetup, operator: Operator | None = None) -> None:
        self._setup = setup
        self._operator = operator
        self._stack = ExitStack()
        self._newest: Report | None = None
        self._returned = -1
        self._closing = False
        self.events: list[str] = []
        """What the state machine has said so far."""

    @classmethod
    def by_itself(cls, setup: LiveSetup) -> Puppet:
        """A robot that stands up, arms and runs as soon as it may: for simulation."""
        return cls(setup, Auto((0.0, 0.0, 0.0), 0.0))

    @property
    def mode(self) -> str:
        """State of the state machine (`State`); empty before anything was heard."""
        return self._newest.mode if self._newest else ""

    def connect(self) -> None:
        """Start the control process and wait until the robot is in RUN.

        Raises:
            EnvironmentFailure: the robot or its camera does not answer, or nobody let it run.
            SafetyStop: its motors were damped instead.
        """
        try:
            self._start()
            self._await(lambda: self._newest is not None, _START_S, "hear from the robot")
            self._await(lambda: self.mode == State.RUN, _STAND_S, "see it run")
        except BaseException:
            self.close()
            raise

    def _start(self) -> None:
        folder = self._stack.enter_context(run_folder())
        address = f"ipc://{folder}/link"
        self._link = Link(address, serve=True)
        self._stack.callback(self._link.close)
        spare = self._stack.enter_context(spare_body(self._setup.hardware.bridge))
        self._process = self._stack.enter_context(started(self._setup, address))
        guard = Guard(self._process, spare, lambda: self._closing)
        self._stack.callback(guard.join_if_acting)

    def _await(self, happened: Callable[[], bool], limit_s: float, what: str) -> None:
        deadline = time.monotonic() + limit_s
        while not happened():
            if not self._process.is_alive():
                raise EnvironmentFailure(
                    f"the control process ended with code {self._process.exitcode}; its own "
                    "message is above. egovcp-deploy --dry_run=true checks robot and camera"
                )
            if self.mode == State.DAMP:
                raise SafetyStop(f"the motors were damped: {'; '.join(self.events)}")
            if time.monotonic() > deadline:
                raise EnvironmentFailure(
                    f"waited {limit_s:g} s to {what}, and found it in {self.mode or 'silence'}; "
                    "on its remote control Y stands it up, A arms it, start lets it run"
                )
            if self._listen(0.02):
                self.send(np.zeros(ACTION_DIM))

    def _listen(self, timeout_s: float) -> bool:
        """Take in what the control process has said; whether there was an observation."""
        for order in (
            self._operator.orders(time.monotonic_ns(), self.mode) if self._operator else ()
        ):
            self._link.send(encode_order(order))
        reports = [decode_report(parts) for parts in self._link.receive(timeout_s)]
        for report in reports:
            if report is not None:
                self._newest = report
                self.events += report.events
        return any(report is not None for report in reports)

    def observe(self) -> Report:
        """The newest observation, waiting for one that was not returned before.

        Raises:
            EnvironmentFailure: none came in half a second.
            SafetyStop: the motors are damped.
        """
        deadline = time.monotonic() + _NEWS_S
        self._listen(0.0)
        while self._newest is None or self._newest.tick == self._returned:
            if time.monotonic() > deadline:
                raise EnvironmentFailure("the robot's control process has fallen silent")
            self._listen(0.02)
        if self.mode == State.DAMP:
            raise SafetyStop(f"the motors were damped: {'; '.join(self.events[-3:])}")
        self._returned = self._newest.tick
        return self._newest

    def send(self, action: NDArray[np.floating]) -> Array:
        """Send an action (7,), box units; what of it the robot will take, (7,).

        Raises:
            UsageError: it is not seven numbers.
        """
        wanted = np.asarray(action, np.float64)
        if wanted.shape != (ACTION_DIM,) or not np.isfinite(wanted).all():
            raise UsageError(f"an action is {ACTION_DIM} numbers in [-1, 1], found {wanted}")
        assert self._newest is not None, "connect first"
        steps = np.repeat(wanted[None, None].astype(np.float32), _KEPT, axis=1)
        step = PolicyStep(steps[:, 0], steps)
        self._link.send(encode_reply(Reply(self._newest.tick, step, 0.0)))
        last = self._newest.sent
        taken = last + np.clip(wanted - last, -ACTION_RATE_LIMIT, ACTION_RATE_LIMIT)
        return np.asarray(np.clip(taken, -1.0, 1.0))

    def close(self) -> None:
        """Hold, let the hands come to rest, damp, and let go; further calls do nothing.

        A robot on its own feet sinks to the ground: hang it up first.
        """
        if self._closing:
            return
        self._closing = True
        if self.mode == State.RUN and self._process.is_alive():
            self._link.send(encode_order(Order(Request.HOLD)))
            time.sleep(EASE_S)
        if self.mode:
            self._link.send(encode_order(Order(quit=True)))
            self._process.join(_END_S)
        self._stack.close()
