"""Changes of the messages that the fake G1 sends: one message in, any number out."""

from __future__ import annotations

import json
import os
import time
import zlib
from collections.abc import Callable, Iterable
from typing import Any, Final

import numpy as np

from egovcp.spec import JOINT_NAMES
from egovcp_deploy.robots.fake.bridge import GARBAGE_BYTES

Tamper = Callable[[bytes], Iterable[bytes]]
Edit = Callable[[dict[str, Any]], None]
"""Changes the data of a decoded state."""

KNEE: Final = JOINT_NAMES.index("left_knee_joint")


def edited(edit: Edit) -> Tamper:
    """Each state, decoded, changed and encoded again."""

    def tamper(message: bytes) -> Iterable[bytes]:
        content = json.loads(message)
        edit(content["data"])
        return (json.dumps(content).encode(),)

    return tamper


def once(tamper: Tamper) -> Tamper:
    """Only the first state."""
    return every(10**9, tamper)


def every(period: int, tamper: Tamper) -> Tamper:
    """The first state and then every ``period``-th."""
    count = iter(range(10**12))
    return lambda message: tamper(message) if next(count) % period == 0 else (message,)


def for_seconds(duration: float, tamper: Tamper) -> Tamper:
    """Only the states of the first ``duration`` s."""
    begin: list[float] = []

    def during(message: bytes) -> Iterable[bytes]:
        now = time.monotonic()
        begin.extend([now] if not begin else [])
        return tamper(message) if now - begin[0] < duration else (message,)

    return during


def nothing(message: bytes) -> Iterable[bytes]:
    """The message is lost."""
    return ()


def garbage(number: int) -> list[bytes]:
    """Random bytes, new each time: the runner drops repeated messages at no cost."""
    return [os.urandom(GARBAGE_BYTES) for _ in range(number)]


def valid_json(number: int) -> list[bytes]:
    """Valid JSON of 30 kB each that is no state."""
    values = np.random.default_rng().random(1500).tolist()
    body = {"topic": "rt/lowstate", "data": {"x": values}}
    return [json.dumps(body | {"n": i}).encode() for i in range(number)]


def followed_by(extra: Callable[[], Iterable[bytes]]) -> Tamper:
    """Each state, and further messages after it."""
    return lambda message: (message, *extra())


def motor(joint: int, name: str, change: Callable[[float], object]) -> Edit:
    """Change one field of one motor."""

    def edit(data: dict[str, Any]) -> None:
        motor = data["motor_state"][joint]
        motor[name] = change(motor[name])

    return edit


def all_motors(name: str, change: Callable[[int, float], object]) -> Edit:
    """Change one field of every motor, from its index and value."""

    def edit(data: dict[str, Any]) -> None:
        for i, motor in enumerate(data["motor_state"][: len(JOINT_NAMES)]):
            motor[name] = change(i, motor[name])

    return edit


def without_motor_fields(*names: str) -> Edit:
    """Remove fields of every motor."""

    def edit(data: dict[str, Any]) -> None:
        for motor in data["motor_state"]:
            for name in names:
                motor.pop(name, None)

    return edit


def imu(name: str, change: Callable[[list[float]], object]) -> Edit:
    """Change one field of the IMU."""

    def edit(data: dict[str, Any]) -> None:
        data["imu_state"][name] = change(data["imu_state"][name])

    return edit


def set_field(name: str, value: object) -> Edit:
    """Set a field of the state."""
    return lambda data: data.__setitem__(name, value)


def without_field(name: str) -> Edit:
    """Remove a field of the state."""

    def edit(data: dict[str, Any]) -> None:
        del data[name]

    return edit


def rolled(quaternion: list[float], angle: float = 0.8) -> list[float]:
    """The orientation (w, x, y, z) after a rotation about its own x axis by ``angle`` rad."""
    w, x, y, z = quaternion
    c, s = np.cos(angle / 2), np.sin(angle / 2)
    return [float(v) for v in (w * c - x * s, w * s + x * c, y * c + z * s, z * c - y * s)]


def random_joints(data: dict[str, Any]) -> None:
    """Random joint positions and speeds within the limits."""
    rng = np.random.default_rng(zlib.crc32(json.dumps(data["motor_state"][0]).encode()))
    for motor in data["motor_state"][: len(JOINT_NAMES)]:
        motor["q"] = float(rng.uniform(-0.2, 0.2))
        motor["dq"] = float(rng.uniform(-10, 10))


def raw_position(number: str) -> Tamper:
    """Write ``number``, which may be invalid JSON, as the position of the left knee."""
    text = "replaced"  # occurs nowhere else in the message

    def tamper(message: bytes) -> Iterable[bytes]:
        content = json.loads(message)
        content["data"]["motor_state"][KNEE]["q"] = text
        return (json.dumps(content).replace(f'"{text}"', number).encode(),)

    return tamper


def repeats() -> Tamper:
    """Each state is the first one, twenty times."""
    first: list[bytes] = []

    def tamper(message: bytes) -> Iterable[bytes]:
        first.extend([message] if not first else [])
        return first * 20

    return tamper


def bad_checksum(message: bytes) -> Iterable[bytes]:
    """A picture with another checksum."""
    return (message[:-1] + bytes([message[-1] ^ 1]),)


def wrong_field_of_view(message: bytes) -> Iterable[bytes]:
    """A picture of another camera."""
    return (message[:12] + np.float32(2.0).tobytes() + message[16:],)
