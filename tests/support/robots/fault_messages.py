"""Alterations of the messages that the fake G1 sends: one message in, any number out."""

from __future__ import annotations

import json
import os
import time
import zlib
from collections.abc import Callable, Iterable
from typing import Any, Final

import numpy as np

from egovcp.spec import JOINT_NAMES

Alteration = Callable[[bytes], Iterable[bytes]]
Edit = Callable[[dict[str, Any]], None]
"""Changes the data of a decoded state in place."""

GARBAGE_BYTES: Final = 2000
KNEE: Final = JOINT_NAMES.index("left_knee_joint")


def edited(edit: Edit) -> Alteration:
    """Decode each state, change it and encode it again."""

    def alter(message: bytes) -> Iterable[bytes]:
        content = json.loads(message)
        edit(content["data"])
        return (json.dumps(content).encode(),)

    return alter


def once(alteration: Alteration) -> Alteration:
    """Alter only the first state."""
    return every(10**9, alteration)


def every(period: int, alteration: Alteration) -> Alteration:
    """Alter the first state and then every ``period``-th."""
    count = iter(range(10**12))
    return lambda message: alteration(message) if next(count) % period == 0 else (message,)


def for_seconds(duration: float, alteration: Alteration) -> Alteration:
    """Alter only the states of the first ``duration`` s."""
    begin: list[float] = []

    def alter(message: bytes) -> Iterable[bytes]:
        now = time.monotonic()
        begin.extend([now] if not begin else [])
        return alteration(message) if now - begin[0] < duration else (message,)

    return alter


def nothing(message: bytes) -> Iterable[bytes]:
    """Drop the message."""
    return ()


def garbage(number: int) -> list[bytes]:
    """Random bytes, new each time: the runner drops repeated messages without decoding."""
    return [os.urandom(GARBAGE_BYTES) for _ in range(number)]


def valid_json(number: int) -> list[bytes]:
    """Valid JSON of 30 kB each that is not a state."""
    values = np.random.default_rng().random(1500).tolist()
    body = {"topic": "rt/lowstate", "data": {"x": values}}
    return [json.dumps(body | {"n": i}).encode() for i in range(number)]


def followed_by(extra: Callable[[], Iterable[bytes]]) -> Alteration:
    """Send each state, and further messages after it."""
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


def gyroscope(rate: float) -> Edit:
    """Set the gyroscope's x axis, rad/s."""
    return imu("gyroscope", lambda w: [rate, *w[1:]])


def set_field(name: str, value: object) -> Edit:
    """Set a field of the state."""
    return lambda data: data.__setitem__(name, value)


def without_field(name: str) -> Edit:
    """Remove a field of the state."""
    return lambda data: data.__delitem__(name)


def rolled(quaternion: list[float], angle: float = 0.8) -> list[float]:
    """Rotate the orientation (w, x, y, z) about its own x axis by ``angle`` rad."""
    w, x, y, z = quaternion
    c, s = np.cos(angle / 2), np.sin(angle / 2)
    return [float(v) for v in (w * c - x * s, w * s + x * c, y * c + z * s, z * c - y * s)]


def random_joints(data: dict[str, Any]) -> None:
    """Set random joint positions and speeds within the limits."""
    rng = np.random.default_rng(zlib.crc32(json.dumps(data["motor_state"][0]).encode()))
    for motor in data["motor_state"][: len(JOINT_NAMES)]:
        motor["q"] = float(rng.uniform(-0.2, 0.2))
        motor["dq"] = float(rng.uniform(-10, 10))


def raw_position(number: str) -> Alteration:
    """Write ``number``, which may be invalid JSON, as the position of the left knee."""
    text = "replaced"  # occurs nowhere else in the message

    def alter(message: bytes) -> Iterable[bytes]:
        content = json.loads(message)
        content["data"]["motor_state"][KNEE]["q"] = text
        return (json.dumps(content).replace(f'"{text}"', number).encode(),)

    return alter


def repeats() -> Alteration:
    """Replace each state by the first one, twenty times."""
    first: list[bytes] = []

    def alter(message: bytes) -> Iterable[bytes]:
        first.extend([message] if not first else [])
        return first * 20

    return alter


def bad_checksum(message: bytes) -> Iterable[bytes]:
    """A depth image with a wrong checksum."""
    return (message[:-1] + bytes([message[-1] ^ 1]),)


def wrong_field_of_view(message: bytes) -> Iterable[bytes]:
    """A depth image with a wrong field of view."""
    return (message[:12] + np.float32(2.0).tobytes() + message[16:],)
