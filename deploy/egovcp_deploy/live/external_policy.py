"""A G1 under the policy of another program: observations out, actions in.

The control process of `egovcp-deploy` stands the robot up, holds it when actions stop coming, and
damps it when necessary, with the same state machine and limits.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure, SafetyStop, UsageError
from egovcp.plan import PolicyStep
from egovcp.spec import ACTION_DIM, ACTION_RATE_LIMIT
from egovcp_deploy.live.hardware import RobotOptions
from egovcp_deploy.live.link import decode_observation, encode_operator_command, encode_plan
from egovcp_deploy.live.operators import EASE_S, Operator
from egovcp_deploy.live.processes import running_control
from egovcp_deploy.pilot.planner import ObservationMessage, PlanMessage
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest, State

Array = NDArray[np.float64]

_START_S: Final = 120.0  # for the operator to bring the robot to RUN
_OBSERVATION_S: Final = 0.5  # longest wait for an observation; one comes every 40 ms
_PLAN_TICKS: Final = 4  # that an action covers, its own included, if the next one is late


class ExternalPolicyRobot:
    """One robot, from `connect` to `close`. ``operator`` requests standing up, arming and running;
    None: only the remote control does."""

    def __init__(self, options: RobotOptions, operator: Operator | None = None) -> None:
        self._options, self._operator = options, operator
        self._stack = ExitStack()
        self._newest: ObservationMessage | None = None
        self._returned = -1
        self._closing = False
        self.events: list[str] = []  # log lines of the state machine

    @property
    def mode(self) -> str:
        """`State` of the state machine; empty before the first observation."""
        return self._newest.mode if self._newest else ""

    def connect(self) -> None:
        """Start the control process and wait until the robot is in RUN. Raises `EnvironmentFailure`
        if robot or camera do not answer, or it was not brought to RUN, `SafetyStop` if it was
        damped."""
        try:
            self._control = self._stack.enter_context(running_control(self._options))
            deadline = time.monotonic() + _START_S
            while self.mode != State.RUN:
                self._control.check_alive()
                self._check_damped()
                if time.monotonic() > deadline:
                    raise EnvironmentFailure(
                        f"waited {_START_S:g} s for RUN, the robot is in {self.mode or 'no state'};"
                        " on its remote control Y stands it up, A arms it, start lets it run"
                    )
                if self._receive(0.02):
                    self.send(np.zeros(ACTION_DIM))
        except BaseException:
            self.close()
            raise

    def _check_damped(self) -> None:
        if self.mode == State.DAMP:
            raise SafetyStop(f"the motors were damped: {'; '.join(self.events[-3:])}")

    def _receive(self, timeout_s: float) -> bool:
        """Exchange messages with the control process; whether there was an observation."""
        if self._operator is not None:
            for command in self._operator.commands(time.monotonic_ns(), self.mode):
                self._send(command)
        received = False
        for parts in self._control.link.receive(timeout_s):
            observation = decode_observation(parts)
            if observation is not None:
                self._newest, received = observation, True
                self.events += observation.events
        return received

    def observe(self) -> ObservationMessage:
        """The newest observation, after waiting for one that was not returned before. Raises
        `EnvironmentFailure` if none came in half a second, `SafetyStop` if the motors are damped.
        """
        deadline = time.monotonic() + _OBSERVATION_S
        self._receive(0.0)
        while self._newest is None or self._newest.tick == self._returned:
            if time.monotonic() > deadline:
                raise EnvironmentFailure("the robot's control process does not answer any more")
            self._receive(0.02)
        self._check_damped()
        self._returned = self._newest.tick
        return self._newest

    def send(self, action: NDArray[np.floating]) -> Array:
        """Send an action (7,), clipped to [-1, 1]; returns it as rate limited by the robot, (7,).
        Raises `UsageError` if it is not seven finite numbers."""
        wanted = np.asarray(action, np.float64)
        if wanted.shape != (ACTION_DIM,) or not np.isfinite(wanted).all():
            raise UsageError(f"an action is {ACTION_DIM} finite numbers, found {wanted}")
        assert self._newest is not None, "connect first"
        actions = np.repeat(wanted[None, None].astype(np.float32), _PLAN_TICKS, axis=1)
        plan = PlanMessage(self._newest.tick, PolicyStep(actions[:, 0], actions), 0.0)
        self._control.link.send(encode_plan(plan))
        last = self._newest.sent
        sent = last + np.clip(wanted - last, -ACTION_RATE_LIMIT, ACTION_RATE_LIMIT)
        return np.asarray(np.clip(sent, -1.0, 1.0))

    def _send(self, command: OperatorCommand) -> None:
        self._control.link.send(encode_operator_command(command))

    def close(self) -> None:
        """Hold, ease the hands to neutral, damp, and disconnect; further calls do nothing. A robot
        on its own feet collapses to the floor: hang it up first."""
        if self._closing:
            return
        self._closing = True
        try:
            if self.mode == State.RUN and self._control.process.is_alive():
                self._send(OperatorCommand(OperatorRequest.HOLD))
                time.sleep(EASE_S)
            if self.mode:
                self._send(OperatorCommand(quit=True))
                self._control.watchdog.expected = lambda: True
        finally:  # also after an interrupt: it ends the control process, which damps
            self._stack.close()
