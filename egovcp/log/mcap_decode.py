"""Decodes the messages of a tick: the inverse of `egovcp.log.messages`."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovcp.log.messages import VALUE_MAPS, Topic
from egovcp.log.tick import BasePose, Candidates, MotorReadings, SceneObject, Tick, ValueMap
from egovcp.spec import DEPTH_COLS

_FLAGS = ("terminated", "truncated", "success")


def decode_tick(index: int, time_ns: int, messages: Mapping[str, Any]) -> Tick:
    """The inverse of `messages.encode_tick`; decoded depths come back in whole millimetres."""
    reward = _scalars(messages[Topic.REWARD])
    plan = _scalars(messages.get(Topic.PLAN_SCALARS))
    flags = {name: bool(reward.pop(name)) for name in _FLAGS}
    total = reward.pop("reward")
    log = messages.get(Topic.LOG)
    sent = _array(messages[Topic.ACTION]).astype(np.float32)
    planned = messages.get(Topic.ACTION_PLANNED)
    return Tick(
        index=index,
        time_ns=time_ns,
        depth=_image(messages[Topic.DEPTH]),
        state=_array(messages[Topic.STATE]).astype(np.float32),
        action_planned=sent if planned is None else _array(planned).astype(np.float32),
        action_sent=sent,
        depth_reconstructed=_metres(messages.get(Topic.RECONSTRUCTED)),
        depth_imagined=_film(messages.get(Topic.IMAGINED)),
        plan=_array(messages[Topic.PLAN]) if Topic.PLAN in messages else None,
        candidates=_candidates(messages.get(Topic.CANDIDATES)),
        value=plan.get("value"),
        termination=plan.get("termination"),
        value_maps=_value_maps(messages),
        reward=total,
        reward_terms=reward,
        timing_ms=_scalars(messages.get(Topic.TIMING)),
        base=_base(messages.get(Topic.BASE)),
        scene=_scene(messages.get(Topic.SCENE)),
        events=tuple(log.msg.split("\n")) if log else (),
        mode=decode_mode(messages.get(Topic.MODE)),
        motors=motor_readings(messages),
        link=_scalars(messages.get(Topic.LINK)),
        terminated=flags["terminated"],
        truncated=flags["truncated"],
        success=flags["success"],
    )


def motor_readings(messages: Mapping[str, Any]) -> MotorReadings | None:
    """From the decoded messages of a tick, topic -> message; None: no torque was recorded."""
    joints = messages.get(Topic.JOINTS)
    if joints is None or not len(joints.effort):
        return None
    temperature = messages.get(Topic.MOTOR_TEMPERATURE)
    status = _rows(messages.get(Topic.MOTOR_STATUS))
    return MotorReadings(
        torque=np.array(joints.effort, np.float64),
        temperature=None if temperature is None else _array(temperature).T,
        faults=_integers(status.get("faults")),
        lost=_integers(status.get("lost")),
        enabled=None if "enabled" not in status else status["enabled"] != 0.0,
    )


def _rows(message: Any) -> dict[str, NDArray[np.float64]]:
    """Label -> row of a matrix."""
    if message is None:
        return {}
    names = message.layout.dim[0].label.split(",")
    return dict(zip(names, _array(message), strict=True))


def _integers(row: NDArray[np.float64] | None) -> NDArray[np.int64] | None:
    return None if row is None else row.astype(np.int64)


def _array(message: Any) -> NDArray[np.float64]:
    shape = [dimension.size for dimension in message.layout.dim]
    return np.array(message.data, np.float64).reshape(shape)


def _scalars(message: Any) -> dict[str, float]:
    if message is None:
        return {}
    names = message.layout.dim[0].label.split(",")
    return dict(zip(names, map(float, message.data), strict=True))


def decode_mode(message: Any) -> str:
    """The state of the state machine; empty if none was recorded."""
    return "".join(name for name, is_in in _scalars(message).items() if is_in)


def _image(message: Any) -> NDArray[np.uint16]:
    return np.frombuffer(message.data, "<u2").reshape(message.height, message.width)


def _metres(message: Any) -> NDArray[np.float64] | None:
    return None if message is None else _image(message) / 1000.0


def _film(message: Any) -> NDArray[np.float64] | None:
    strip = _metres(message)
    return None if strip is None else np.stack(np.split(strip, strip.shape[1] // DEPTH_COLS, 1))


def _candidates(message: Any) -> Candidates | None:
    if message is None:
        return None
    points = np.frombuffer(message.data, "<f4").reshape(message.height, -1, 2, 4)
    return Candidates(hands_b=points[..., :3], values=points[:, 0, 0, 3])


def _value_maps(messages: Mapping[str, Any]) -> tuple[ValueMap, ...]:
    maps = []
    for hand, topic in VALUE_MAPS.items():
        if topic in messages:
            message = messages[topic]
            cloud = np.frombuffer(message.data, "<f4").reshape(message.height, message.width, 4)
            x, z, y = cloud[0, :, 0], cloud[:, 0, 2], float(cloud[0, 0, 1])
            maps.append(ValueMap(hand, x, y, z, cloud[..., 3]))
    return tuple(maps)


def _base(message: Any) -> BasePose | None:
    if message is None:
        return None
    p, q = message.pose.position, message.pose.orientation
    return BasePose(np.array([p.x, p.y, p.z]), np.array([q.w, q.x, q.y, q.z]))


def _scene(message: SimpleNamespace | None) -> tuple[SceneObject, ...]:
    if message is None:
        return ()
    names = [label.split(":") for label in message.layout.dim[0].label.split(",")]
    rows = _array(message).tolist()
    return tuple(
        SceneObject(name, "sphere" if shape == "sphere" else "box", *_split(row))
        for (name, shape), row in zip(names, rows, strict=True)
    )


type _Triple = tuple[float, float, float]


def _split(row: list[float]) -> tuple[_Triple, tuple[float, float, float, float], _Triple]:
    x, y, z, qw, qx, qy, qz, sx, sy, sz = row
    return (x, y, z), (qw, qx, qy, qz), (sx, sy, sz)
