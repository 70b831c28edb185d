"""The simulated robot behind the wire: one call of `FakeBridge.step` is 5 ms of its life.

Commands in, physics, a state out; a picture whenever the camera has one. What the motors do
without commands is this fake's own choice, not knowledge about the robot: after 0.2 s they damp.
"""

from __future__ import annotations

import os
from collections import deque
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
from egovcp.sim.live import DAMPED, LiveRobot, Phase, ServoCommand
from egovcp.spec import JOINT_NAMES, NUM_JOINTS, PHYSICS_DT
from egovcp_deploy.robots.body import BodyState
from egovcp_deploy.robots.depth_wire import WirePicture, encode_picture
from egovcp_deploy.robots.fake.faults import Faults
from egovcp_deploy.robots.motor_fields import DISCONNECTED
from egovcp_deploy.robots.remote import Remote
from egovcp_deploy.robots.wire import (
    CAMERA_PORT,
    COMMAND_PORT,
    MOST_BYTES,
    STATE_PORT,
    Garbled,
    LowCommand,
    LowState,
    decode_command,
    encode_state,
)

WATCHDOG_S: Final = 0.2
MODE: Final = 5  # what the fake reports as its mode machine
_MOTOR_DEG_C: Final = 35.0
_COUNTED_S: Final = 0.5  # how long a program counts as one that sends commands
_MOST_PER_STEP: Final = 100  # commands taken in within 5 ms; the rest waits
GARBAGE_BYTES: Final = 2000
_FALSE_JOINT: Final = JOINT_NAMES.index("left_knee_joint")


@dataclass(frozen=True)
class Ports:
    """Where the fake listens; port 0 stands for any that is free."""

    host: str = "127.0.0.1"
    """Interface; the loopback lets nobody else in."""
    command_port: int = bounded(COMMAND_PORT, least=0, most=65535)
    """Commands."""
    state_port: int = bounded(STATE_PORT, least=0, most=65535)
    """States."""
    camera_port: int = bounded(CAMERA_PORT, least=0, most=65535)
    """Depth pictures, in our own format."""


@dataclass
class Counts:
    """What came in."""

    commands: int = 0
    """Obeyed, or replaced by a newer one within the same 5 ms."""
    garbled: int = 0
    ignored: int = 0
    """For another mode machine than the robot's, or motor by motor; a G1 obeys neither."""


class FakeBridge:
    """Serves one `LiveRobot`.

    Args:
        robot: in an episode (`LiveRobot.start`).
        ports: where to listen.
        faults: may be changed at any time.
        announce: whether states tell how many programs send commands, which LeRobot's bridge
            does not.
        detailed: whether states tell casing and winding temperatures, status and lost packets of
            each motor; LeRobot's bridge sends one temperature and no status.

    Raises:
        EnvironmentFailure: a port is in use.
    """

    def __init__(
        self,
        robot: LiveRobot,
        ports: Ports | None = None,
        faults: Faults | None = None,
        announce: bool = False,
        detailed: bool = False,
    ) -> None:
        self._robot = robot
        self.faults = faults or Faults()
        self.pressed: frozenset[str] = frozenset()
        self.tamper_state: Callable[[bytes], Iterable[bytes]] = lambda message: (message,)
        """A state as it is -> the messages that are sent for it."""
        self.tamper_picture: Callable[[bytes], Iterable[bytes]] = lambda message: (message,)
        """Likewise for pictures."""
        self.on_command: Callable[[bytes], None] = lambda message: None
        """Called with every message on the command port."""
        self.counts = Counts()
        self._announce = announce
        self._detailed = detailed
        self._rng = np.random.default_rng(0)
        self._senders: dict[int, float] = {}
        self._time = 0.0  # s of simulated time since the start
        self._last_command = -np.inf
        self._servos = DAMPED
        self._last_state = b""
        self._sequence = 0
        self._shown: tuple[int, int] | None = None
        self._episode = 0
        self._context = zmq.Context()
        wanted = ports or Ports()
        self._commands = self._bind(zmq.PULL, wanted.host, wanted.command_port)
        self._states = self._bind(zmq.PUB, wanted.host, wanted.state_port)
        self._pictures = self._bind(zmq.PUB, wanted.host, wanted.camera_port)
        ends = (self._commands, self._states, self._pictures)
        self.ports = Ports(wanted.host, *map(_port, ends))
        """Where it listens."""

    def _bind(self, kind: int, host: str, port: int) -> zmq.Socket[bytes]:
        end = self._context.socket(kind)
        end.setsockopt(zmq.LINGER, 0)
        end.setsockopt(zmq.SNDHWM, 20)
        end.setsockopt(zmq.MAXMSGSIZE, MOST_BYTES)
        try:
            end.bind(f"tcp://{host}:{port or '*'}")
        except zmq.ZMQError as error:
            end.close()
            self._context.destroy(linger=0)
            raise EnvironmentFailure(
                f"cannot listen at {host}:{port}: {error.strerror}; end what uses the port, "
                "perhaps another egovcp-fake-g1, or choose another"
            ) from error
        return end

    @property
    def robot(self) -> LiveRobot:
        """What is behind the wire."""
        return self._robot

    @property
    def commanded(self) -> bool:
        """Whether the motors are told to hold anything."""
        return self._servos is not DAMPED and bool(self._servos.stiffness.any())

    @property
    def time(self) -> float:
        """s of simulated time since the start, all episodes together."""
        return self._time

    def next_episode(self) -> None:
        """Whoever holds the robot has started another episode."""
        self._episode += 1

    def step(self) -> None:
        """Let 5 ms pass."""
        self._listen()
        self._happen()
        self.robot.drive(self._obeyed())
        self.robot.advance()
        self._time += PHYSICS_DT
        self._publish_state()
        self._publish_picture()

    def _listen(self) -> None:
        """Take the newest command that makes sense; without any for too long, damp."""
        waiting: deque[bytes] = deque()
        while len(waiting) < _MOST_PER_STEP:
            try:
                frame = self._commands.recv(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            self._senders[int(frame.get(zmq.SRCFD))] = self._time
            waiting.append(frame.bytes)
            self.on_command(frame.bytes)
        while waiting and not self.faults.deaf:
            if self._take(waiting.pop()):
                self.counts.commands += len(waiting)
                break
        if self._time - self._last_command > WATCHDOG_S:
            self._servos = DAMPED

    def _take(self, payload: bytes) -> bool:
        """Whether the command is obeyed."""
        try:
            command = decode_command(payload)
        except Garbled:
            self.counts.garbled += 1
            return False
        if command.motors.mode != self._mode or not command.series:
            self.counts.ignored += 1
            return False
        self.counts.commands += 1
        self._last_command = self._time
        self._servos = _servos(command)
        return True

    @property
    def _mode(self) -> int:
        return MODE if self.faults.mode is None else self.faults.mode

    def _happen(self) -> None:
        """Faults that happen once."""
        faults = self.faults
        if faults.push is not None:
            self.robot.push(np.array([*faults.push, 0.0]))
            faults.push = None
        if faults.release:
            self.robot.release()
            faults.release = False

    def _obeyed(self) -> ServoCommand:
        """What the motors do: what they are told, or what a fault makes them do."""
        servos = self._intruder() if self.faults.intruder else self._servos
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
        """What the motors report, in as much detail as this fake's states have."""
        faults = self.faults
        temperature = np.full((NUM_JOINTS, 2), _MOTOR_DEG_C)
        if faults.hot_motor is not None:
            joint, degrees = faults.hot_motor
            temperature[joint] = _MOTOR_DEG_C, degrees
        if not self._detailed:
            temperature = temperature.mean(axis=1, keepdims=True)  # as LeRobot's bridge does
        readings = MotorReadings(torque, None if faults.no_temperature else temperature)
        if not self._detailed:
            return readings
        status, lost = np.zeros(NUM_JOINTS, np.int64), np.zeros(NUM_JOINTS, np.int64)
        if faults.dropped_motor is not None:
            status[faults.dropped_motor] = DISCONNECTED
            lost[faults.dropped_motor] = self.robot.steps
        return replace(readings, faults=status, lost=lost, enabled=status == 0)

    def _intruder(self) -> ServoCommand:
        """Another program, which holds every joint where it is, a little askew."""
        joints = self.robot.robot.data.qpos[self.robot.robot.index.joint_qpos]
        return ServoCommand(joints + 0.1, STIFFNESS, DAMPING)

    def _publish_state(self) -> None:
        faults = self.faults
        if faults.mute_state:
            return
        if not (faults.freeze_state and self._last_state):
            self._last_state = self._state()
        if self._lost():
            return
        torn = faults.garble_state and self.robot.steps % 2
        state = self._last_state[: len(self._last_state) // 2 if torn else None]
        for message in self.tamper_state(state):
            self._states.send(message)
        for _ in range(faults.flood):
            self._states.send(os.urandom(GARBAGE_BYTES))

    def _lost(self) -> bool:
        return self.faults.drop > 0.0 and bool(self._rng.random() < self.faults.drop)

    def _state(self) -> bytes:
        seen = self.robot.measure()
        speed, rate = seen.joint_velocity, seen.angular_velocity
        if self.faults.joint_speed:
            speed[_FALSE_JOINT] = self.faults.joint_speed
        if self.faults.gyroscope:
            rate[0] = self.faults.gyroscope
        body = BodyState(
            time_ns=0,
            joint_position=seen.joint_position,
            joint_velocity=speed,
            quaternion_w=seen.quaternion_w,
            angular_velocity=rate,
            mode=self._mode,
            remote=Remote.asking_for(self.robot.operator_velocity, self.pressed).to_bytes(),
            motors=self._motors(seen.torque),
        )
        return encode_state(LowState(body, self._sources()), seen.acceleration)

    def _sources(self) -> int | None:
        """How many programs send commands."""
        if not (self._announce or self.faults.announce):
            return None
        recent = sum(self._time - last < _COUNTED_S for last in self._senders.values())
        return recent + self.faults.announce

    def _publish_picture(self) -> None:
        taken, depth = self.robot.depth_image
        if self.faults.mute_camera or (self._episode, taken) == self._shown:
            return
        self._shown = (self._episode, taken)
        if not self.faults.freeze_camera:
            self._sequence += 1
            fov = self.robot.config.camera.vertical_fov
            age = (self.robot.steps - taken) * PHYSICS_DT
            self._last_picture = encode_picture(WirePicture(self._sequence, fov, depth, age))
        if self._sequence and not self._lost():
            for message in self.tamper_picture(self._last_picture):
                self._pictures.send(message)

    @property
    def over(self) -> bool:
        """Whether the episode has come to its end."""
        return self.robot.phase is Phase.OVER

    def close(self) -> None:
        """Stop listening."""
        self._context.destroy(linger=0)


def _port(end: zmq.Socket[bytes]) -> int:
    """The port that a socket is bound to."""
    return int(end.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])


def _servos(command: LowCommand) -> ServoCommand:
    """What the motors do; one that is not enabled does nothing at all."""
    on = command.enabled.astype(np.float64)
    motors = command.motors
    return ServoCommand(
        motors.position,
        on * motors.stiffness,
        on * motors.damping,
        command.velocity,
        on * command.torque,
    )
