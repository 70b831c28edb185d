"""A live run for fault injection: fake G1, ZMQ, control process, scripted planner.

The control process is the real one. In this process its robot is simulated in real time, its
planner answers every report, and every command that it sends is recorded.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from ctypes import c_bool
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.plan import PolicyStep
from egovcp.rate import MonotonicClock
from egovcp.robot.kinematics import TARGET_HIGH, TARGET_LOW
from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.live import DAMPED, LiveRobot
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_DIM
from egovcp_deploy.live.control_process import RECEIVER_PRIORITY, control_process
from egovcp_deploy.live.hardware import CameraOptions, RobotOptions
from egovcp_deploy.live.link import Link, decode_observation, encode_operator_command, encode_plan
from egovcp_deploy.live.processes import DampingWatchdog, standby_body
from egovcp_deploy.pilot.planner import ObservationMessage, PlanMessage
from egovcp_deploy.pilot.states import Limits, OperatorCommand, OperatorRequest, State
from egovcp_deploy.robots.bridge import BridgeConfig
from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from egovcp_deploy.robots.fake.command import StepPacer
from egovcp_deploy.robots.fake.faults import InjectedFaults
from egovcp_deploy.robots.wire import MalformedMessage, decode_command
from egovcp_deploy.robots.zmq_camera import ZmqCameraConfig

from .fake_g1 import raised_priority
from .stream_proxy import StreamFault, StreamProxy

Array = NDArray[np.float64]
Planner = Callable[[ObservationMessage], list[list[bytes]]]
"""ObservationMessage -> the messages that are sent as an answer."""

LIMITS: Final = Limits(stand_s=0.1, recover_s=0.2)
_START_S: Final = 60.0
_STARTS: Final = 5
_REPORT_S: Final = 0.1  # until the report with the reason arrives

_FORKSERVER: Final = multiprocessing.get_context("forkserver")
# Each child imports the main module again, so its imports are preloaded as well.
_FORKSERVER.set_forkserver_preload(
    [
        __name__,
        "egovcp_deploy.live.control_process",
        "egovcp.robot.controllers",
        "egovcp.sim.live",
        "pytest",
    ]
)


@dataclass(frozen=True)
class ReceivedCommand:
    """One message on the command port."""

    time_ns: int
    position: Array | None
    """(29,) rad; None: the message was malformed."""
    damped: bool
    """Whether the stiffness of all motors is zero."""
    valid: bool
    """Whether it is finite and within the bounds of the joints' targets."""


@dataclass
class Observed:
    """What happened since a fault began."""

    modes: list[tuple[int, str]] = field(default_factory=list)
    """(time, state) of each report."""
    events: list[str] = field(default_factory=list)
    commands: list[ReceivedCommand] = field(default_factory=list)
    onset_ns: int = 0
    """When the fault began."""
    last_good_ns: int = 0
    """When the last state before it was sent."""

    @property
    def damped_ns(self) -> int | None:
        """When the first damping command arrived; None: none did."""
        return next((c.time_ns for c in self.commands if c.damped), None)

    @property
    def held_ns(self) -> int | None:
        """When the first report from HOLD was made, a multiple of 40 ms; None: none was."""
        return next((t for t, mode in self.modes if mode == State.HOLD), None)

    @property
    def max_change(self) -> float:
        """Largest change of a target between two commands, rad."""
        following = [c.position for c in self.commands if not c.damped and c.position is not None]
        if len(following) < 2:
            return 0.0
        return float(np.abs(np.diff(np.stack(following), axis=0)).max())


def constant_reply(report: ObservationMessage, level: float = 0.3) -> PlanMessage:
    """A plan that reaches a little, with the pelvis at its neutral height."""
    plan = np.full((1, 4, ACTION_DIM), level, np.float32)
    plan[..., -1] = 0.0
    return PlanMessage(report.tick, PolicyStep(plan[:, 0], plan, iterations=1), 1.0)


def constant_plan(report: ObservationMessage) -> list[list[bytes]]:
    """Answer of a planner without faults."""
    return [encode_plan(constant_reply(report))]


def _run_control_process(options: RobotOptions, address: str) -> None:
    control_process(options, address, os.getppid(), c_bool())  # the fork server


class FaultRig:
    """Starts live runs and injects faults into them. Close it afterwards."""

    def __init__(self) -> None:
        quiet = EpisodeConfig(empty_probability=1.0)  # never begins: there is no time limit
        self._robot = LiveRobot(EnvConfig(controller="stance", ball_episode=quiet))
        self._robot.start(Scenario("ball", 0, 0))
        free = Ports(command_port=0, state_port=0, camera_port=0)
        with raised_priority(RECEIVER_PRIORITY):  # a real robot has its own computers
            self.fake = FakeBridge(self._robot, free, detailed=True)
            self.proxy = StreamProxy(self.fake.ports.state_port)
        self.fake.on_command = self._record
        self.planner: Planner = constant_plan
        self._tasks: deque[tuple[Callable[[], None], threading.Event]] = deque()
        self._outbox: deque[list[bytes]] = deque()
        self._observed = Observed()
        self._sent_ns = 0
        self._mode = ""
        self._session: ExitStack | None = None
        self._ending = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._simulate, daemon=True)
        gc.freeze()  # a long collection would stop the robot
        with raised_priority(RECEIVER_PRIORITY):
            self._thread.start()

    # --- the robot's thread --------------------------------------------------------------
    def _simulate(self) -> None:
        pacer = StepPacer(MonotonicClock())
        while not self._closing.is_set():
            for _ in range(pacer.wait_for_steps()):
                while self._tasks:
                    task, done = self._tasks.popleft()
                    task()
                    done.set()
                self.fake.step()
                self._sent_ns = time.monotonic_ns()

    def in_robot(self, task: Callable[[], None]) -> None:
        """Run ``task`` between two steps of the robot, and wait for it."""
        done = threading.Event()
        self._tasks.append((task, done))
        if not done.wait(_START_S):
            raise RuntimeError("the simulated robot does not step")

    def _record(self, message: bytes) -> None:
        now = time.monotonic_ns()
        try:
            motors = decode_command(message).motors
        except MalformedMessage:
            command = ReceivedCommand(now, None, damped=False, valid=False)
        else:
            target = motors.position
            inside = (target >= TARGET_LOW - 1e-6) & (target <= TARGET_HIGH + 1e-6)
            damped = not motors.stiffness.any()
            command = ReceivedCommand(now, target, damped, valid=bool(inside.all()))
        self._observed.commands.append(command)

    # --- the planner's thread ------------------------------------------------------------
    def _plan(self, link: Link, ending: threading.Event) -> None:
        while not ending.is_set():
            while self._outbox:
                link.send(self._outbox.popleft())
            for parts in link.receive(0.01):
                report = decode_observation(parts)
                if report is None:
                    continue
                self._mode = report.mode
                self._observed.modes.append((report.time_ns, report.mode))
                self._observed.events += report.events
                for message in self.planner(report):
                    link.send(message)

    # --- a run ---------------------------------------------------------------------------
    @property
    def mode(self) -> str:
        """Last reported state of the state machine; empty: no report yet."""
        return self._mode

    @property
    def running(self) -> bool:
        """Whether a run is in RUN."""
        return self._session is not None and self._mode == State.RUN and self.process.is_alive()

    def ensure_running(self) -> None:
        """Bring the run to RUN with the robot on its feet, from any state."""
        if self.running and self._robot.robot.pelvis_height > 0.6:
            return None
        for attempt in range(_STARTS):
            self.end_run()
            self.clear_faults()
            self.in_robot(self._hang_up)
            self._session = ExitStack()
            try:
                return self._start(self._session)
            except RuntimeError:  # a busy machine
                if attempt == _STARTS - 1:
                    raise
            except BaseException:
                self.end_run()
                raise
        return None

    def _hang_up(self) -> None:
        self._robot.start(Scenario("ball", 0, 0))
        self._robot.drive(DAMPED)

    def _start(self, stack: ExitStack) -> None:
        ports, fov = self.fake.ports, self._robot.config.camera.vertical_fov
        bridge = BridgeConfig(state_port=self.proxy.port, command_port=ports.command_port)
        camera = CameraOptions(server=ZmqCameraConfig(port=ports.camera_port, vertical_fov=fov))
        address = f"ipc://{stack.enter_context(tempfile.TemporaryDirectory())}/link"
        with raised_priority(RECEIVER_PRIORITY):
            link = Link(address, serve=True)
        stack.callback(link.close)
        self._outbox.clear()
        spare = stack.enter_context(standby_body(bridge))
        options = RobotOptions(controller="stance", bridge=bridge, camera=camera, limits=LIMITS)
        self._mode, self._ending = "", False
        self.process: BaseProcess = _FORKSERVER.Process(
            target=_run_control_process, args=(options, address), daemon=True
        )
        with raised_priority(RECEIVER_PRIORITY):  # inherited by the fork server
            self.process.start()
        stack.callback(self._end_process)
        guard = DampingWatchdog(self.process, spare, lambda: True)
        guard.expected = lambda: self._ending
        stack.callback(guard.join_if_ended)
        ending = threading.Event()
        planner = threading.Thread(target=self._plan, args=(link, ending), daemon=True)
        with raised_priority(RECEIVER_PRIORITY):
            planner.start()
        stack.callback(planner.join)
        stack.callback(ending.set)
        for request, target in (
            (OperatorRequest.STAND, State.STAND),
            (OperatorRequest.ARM, State.ARMED),
            (OperatorRequest.RUN, State.RUN),
        ):
            self._reach(request, target)
            if target is State.ARMED:
                self.in_robot(self._robot.release)
                time.sleep(0.15)

    def _reach(self, request: OperatorRequest, target: State) -> None:
        deadline = time.monotonic() + _START_S
        next_request = 0.0
        while self._mode != target:
            now = time.monotonic()
            if now > deadline or (self._mode == State.DAMP and target is not State.DAMP):
                raise RuntimeError(f"{self._mode or 'no report'}: {self._observed.events[-3:]}")
            if self._mode and now > next_request:
                self.order(OperatorCommand(request))
                next_request = now + 0.04
            time.sleep(0.005)

    def _end_process(self) -> None:
        self._ending = True
        if self.process.is_alive() and self.process.pid is not None:
            os.kill(self.process.pid, signal.SIGCONT)
            self.process.kill()
        self.process.join()

    def order(self, order: OperatorCommand) -> None:
        """Send an order of the operator."""
        self._outbox.append(encode_operator_command(order))

    def clear_faults(self) -> None:
        """End every fault."""
        self.proxy.fault = StreamFault.PASS
        self.planner = constant_plan
        self.in_robot(self._clear_robot_faults)

    def _clear_robot_faults(self) -> None:
        self.fake.faults = InjectedFaults()
        self.fake.pressed = frozenset()
        self.fake.alter_state = self.fake.alter_image = lambda message: (message,)

    def observe(self, begin: Callable[[], None], over: Callable[[Observed], bool]) -> Observed:
        """Start a fault with ``begin``, between two steps of the robot, and observe until
        ``over``."""
        observed = Observed()

        def start() -> None:
            observed.last_good_ns, observed.onset_ns = self._sent_ns, time.monotonic_ns()
            self._observed = observed
            begin()

        self.in_robot(start)
        while not over(observed):
            time.sleep(0.005)
        time.sleep(_REPORT_S)
        self._observed = Observed()
        return observed

    def end_run(self) -> None:
        """End the control process, if there is one."""
        self._ending = True
        if self._session is not None:
            self._session.close()
            self._session = None
        self._mode = ""

    def close(self) -> None:
        """End everything."""
        self.end_run()
        self._closing.set()
        self._thread.join()
        self.proxy.close()
        self.fake.close()
