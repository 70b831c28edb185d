"""A simulated G1 behind the protocol of LeRobot's bridge.

One call of `FakeBridge.step` advances it by 5 ms: receive commands, step the physics, send a state,
and send a depth image when the camera has a new one. Without commands for 0.2 s its motors damp,
with the gains of `egovcp.robot.g1` instead of those that the runner sends in DAMP. LeRobot's bridge
has no such watchdog: assume that a real robot's motors keep the last command.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import zmq
from numpy.typing import NDArray

from egovcp.bounds import bounded
from egovcp.errors import EnvironmentFailure
from egovcp.log.tick import MotorReadings
from egovcp.robot.g1 import DAMPING, STIFFNESS
from egovcp.sim.live import DAMPED, LiveRobot, ServoCommand
from egovcp.spec import NUM_JOINTS, PHYSICS_DT
from egovcp_deploy.robots import wire
from egovcp_deploy.robots.base import LowState
from egovcp_deploy.robots.fake.faults import InjectedFaults
from egovcp_deploy.robots.subscriber import bind_socket
from egovcp_deploy.robots.zmq_camera import DepthFrame, encode_frame

WATCHDOG_S: Final = 0.2
MODE: Final = 5  # the fake's mode machine
_MOTOR_DEG_C: Final = 35.0
_MAX_COMMANDS: Final = 100  # received per step


@dataclass(frozen=True)
class Ports:
    """Address of the fake G1; port 0 selects any free port."""

    host: str = "127.0.0.1"
    """Interface to listen on; the default is reachable from this machine only."""
    command_port: int = bounded(wire.COMMAND_PORT, least=0, most=65535)
    """Port for commands."""
    state_port: int = bounded(wire.STATE_PORT, least=0, most=65535)
    """Port for states."""
    camera_port: int = bounded(wire.CAMERA_PORT, least=0, most=65535)
    """Port for depth images, in the format of egovcp-depth-server."""


class FakeBridge:
    """Serves one `LiveRobot` that is in an episode; raises `EnvironmentFailure` if a port is in
    use.

    If ``detailed``, states have casing and winding temperatures and status of each motor; LeRobot's
    bridge sends one temperature and no status.
    """

    def __init__(self, robot: LiveRobot, ports: Ports, detailed: bool = False) -> None:
        self.robot = robot
        self.faults = InjectedFaults()  # may be changed at any time
        self.pressed: frozenset[str] = frozenset()
        # State and depth message -> the messages that are sent instead.
        self.alter_state: Callable[[bytes], Iterable[bytes]] = lambda message: (message,)
        self.alter_image: Callable[[bytes], Iterable[bytes]] = lambda message: (message,)
        # Called with every message on the command port.
        self.on_command: Callable[[bytes], None] = lambda message: None
        self._detailed = detailed
        self._rng = np.random.default_rng(0)
        self._time = 0.0  # s of simulated time since the start
        self._last_command = -np.inf
        self._servos = DAMPED
        self._last_state = b""
        self._sequence = 0
        self._depth: NDArray[np.uint16] | None = None  # of the last image
        self._context = zmq.Context()
        try:
            self._commands, command_port = self._bind(zmq.PULL, ports.host, ports.command_port)
            self._states, state_port = self._bind(zmq.PUB, ports.host, ports.state_port)
            self._images, camera_port = self._bind(zmq.PUB, ports.host, ports.camera_port)
        except EnvironmentFailure:
            self.close()
            raise
        self.ports = Ports(ports.host, command_port, state_port, camera_port)

    def _bind(self, kind: int, host: str, port: int) -> tuple[zmq.Socket[bytes], int]:
        end = self._context.socket(kind)
        end.setsockopt(zmq.SNDHWM, 20)
        end.setsockopt(zmq.MAXMSGSIZE, wire.MAX_BYTES)
        return end, bind_socket(end, host, port)

    @property
    def commanded(self) -> bool:
        """Whether the last command has stiffness, so that the motors hold a pose."""
        return bool(self._servos.stiffness.any())

    def step(self) -> None:
        """Advance by 5 ms."""
        self._receive()
        faults = self.faults
        if faults.push is not None:
            self.robot.push(np.array([*faults.push, 0.0]))
            faults.push = None
        if faults.release:
            self.robot.release()
            faults.release = False
        self.robot.drive(self._applied())
        self.robot.advance()
        self._time += PHYSICS_DT
        self._publish_state()
        self._publish_image()

    def _receive(self) -> None:
        """Apply the newest valid command; without one for `WATCHDOG_S`, damp."""
        waiting: list[bytes] = []
        while len(waiting) < _MAX_COMMANDS:
            try:
                waiting.append(self._commands.recv(zmq.NOBLOCK))
            except zmq.Again:
                break
            self.on_command(waiting[-1])
        while waiting and not self.faults.ignore_commands:
            try:
                command = wire.decode_command(waiting.pop())
            except wire.MalformedMessage:
                continue
            motors, on = command.motors, command.enabled.astype(np.float64)
            if motors.mode != self._mode or not command.series:
                continue  # a G1 ignores them too; not series: ankles and waist motor by motor
            self._last_command = self._time
            self._servos = ServoCommand(
                motors.position,
                on * motors.stiffness,
                on * motors.damping,
                command.velocity,
                on * command.torque,
            )
            break
        if self._time - self._last_command > WATCHDOG_S:
            self._servos = DAMPED

    @property
    def _mode(self) -> int:
        return MODE if self.faults.mode is None else self.faults.mode

    def _applied(self) -> ServoCommand:
        """The command that the motors follow, including faults."""
        servos = self._servos
        if self.faults.other_publisher:
            joints = self.robot.robot.data.qpos[self.robot.robot.index.joint_qpos]
            servos = ServoCommand(joints + 0.1, STIFFNESS, DAMPING)
        if self.faults.dropped_motor is None:
            return servos
        works = np.arange(NUM_JOINTS) != self.faults.dropped_motor
        return replace(
            servos,
            stiffness=works * servos.stiffness,
            damping=works * servos.damping,
            torque=works * servos.torque,
        )

    def _motors(self, torque: NDArray[np.float64]) -> MotorReadings:
        """What the motors report."""
        faults = self.faults
        temperature = np.full((NUM_JOINTS, 2), _MOTOR_DEG_C)
        if faults.hot_motor is not None:
            joint, degrees = faults.hot_motor
            temperature[joint] = _MOTOR_DEG_C, degrees
        if not self._detailed:
            temperature = temperature.mean(axis=1, keepdims=True)  # as LeRobot's bridge does
        readings = MotorReadings(torque, temperature)
        if not self._detailed:
            return readings
        status = np.zeros(NUM_JOINTS, np.int64)
        if faults.dropped_motor is not None:
            status[faults.dropped_motor] = wire.DISCONNECTED
        return replace(readings, faults=status, enabled=status == 0)

    def _publish_state(self) -> None:
        faults = self.faults
        if faults.stop_state:
            return
        if not (faults.freeze_state and self._last_state):
            self._last_state = self._encode_state()
        if self._is_dropped():
            return
        cut = faults.truncate_state and self.robot.steps % 2
        message = self._last_state[: len(self._last_state) // 2 if cut else None]
        for altered in self.alter_state(message):
            self._states.send(altered)

    def _is_dropped(self) -> bool:
        return self.faults.drop > 0.0 and bool(self._rng.random() < self.faults.drop)

    def _encode_state(self) -> bytes:
        measured = self.robot.measure()
        remote = wire.RemoteControl.from_velocity(self.robot.operator_velocity, self.pressed)
        state = LowState(
            time_ns=0,
            joint_position=measured.joint_position,
            joint_velocity=measured.joint_velocity,
            quaternion_w=measured.quaternion_w,
            angular_velocity=measured.angular_velocity,
            mode=self._mode,
            remote=remote.to_bytes(),
            motors=self._motors(measured.torque),
        )
        return wire.encode_state(state, measured.acceleration)

    def _publish_image(self) -> None:
        step, depth = self.robot.depth_image
        if self.faults.stop_camera or depth is self._depth:
            return
        self._depth = depth
        if not self.faults.freeze_camera:
            self._sequence += 1
            fov = self.robot.config.camera.vertical_fov
            age = (self.robot.steps - step) * PHYSICS_DT
            self._last_image = encode_frame(DepthFrame(self._sequence, fov, depth, age))
        if self._sequence and not self._is_dropped():
            for altered in self.alter_image(self._last_image):
                self._images.send(altered)

    def close(self) -> None:
        """Stop listening."""
        self._context.destroy(linger=0)
