"""What a regression on true state sees: blocks of numbers per row, and the row in the mirror.

No block tells what the simulator will do next: the tick of the throw or push to come is the
scene's own secret, and a return that hangs on it is not reachable.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from true_state import Array, Columns

from egovcp import spec
from egovcp.data.mirror import STATE_SIGN, STATE_SOURCE, mirror_action, mirror_state

PLANE: Final = 0.32  # m before the pelvis, where hands meet a ball
_NOW: Final = 1e-6  # s, an event of this very tick is still to come
_SLOW: Final = 0.3  # m/s, a ball that comes more slowly than this does not come
_G: Final = 9.81  # m/s^2
_BRACE_FORCE: Final = 5.0  # N, as in the wall's reward

_POLAR: Final = np.array([1.0, -1.0, 1.0], dtype=np.float32)
_VECTORS: Final = (
    "gravity",
    "velocity_b",
    "camera_b",
    "object_b",
    "object_velocity_b",
    "object_ahead_b",
)
_PAIRS: Final = ("hands_b", "feet_b")
_PARTS: Final = ("force", "touched_ticks")
_OTHER_PART: Final = [1, 0, 3, 2, 4, 5, 6]  # of `egovcp.sim.scene.PARTS`

#: Name -> blocks: everything; without what is worked out of it; without the single joints.
SETS: Final = {
    "all": ("body", "joints", "object", "path"),
    "state": ("body", "joints", "object"),
    "told": ("body", "object", "path"),
}


def mirrored(columns: Columns) -> Columns:
    """The rows as they would be in a mirror, left for right."""
    out = dict(columns)
    out["state"] = mirror_state(columns["state"])
    out["action"] = mirror_action(columns["action"])
    for name in ("joint_position", "joint_velocity"):
        part = spec.STATE_SLICES[name]
        out[name] = columns[name][:, STATE_SOURCE[part] - part.start] * STATE_SIGN[part]
    for name in _VECTORS:
        out[name] = columns[name] * _POLAR
    for name in _PAIRS:
        out[name] = columns[name][:, [3, 4, 5, 0, 1, 2]] * np.tile(_POLAR, 2)
    for name in _PARTS:
        out[name] = columns[name][:, _OTHER_PART]
    return out


def blocks(task: str, columns: Columns) -> dict[str, Array]:
    """Block -> (N, width) of the rows of one task."""
    path = {"ball": _ball, "wall": _wall, "arch": _arch}[task]
    found = {
        "body": _body(columns),
        "joints": _stack(columns["state"], columns["joint_position"], columns["joint_velocity"]),
        "object": _object(task, columns),
        "path": path(columns),
    }
    return {name: block.astype(np.float32) for name, block in found.items()}


def happened(columns: Columns) -> NDArray[np.bool_]:
    """(N, 1) whether throw, push or start lie behind the row."""
    return np.asarray(columns["since_event"] > _NOW)


def _stack(*parts: NDArray[np.floating] | NDArray[np.bool_]) -> NDArray[np.floating]:
    return np.concatenate([np.asarray(part, dtype=np.float32) for part in parts], axis=1)


def _body(c: Columns) -> NDArray[np.floating]:
    """The robot without its single joints, the action, and what the action costs."""
    base = [c[n] for n in ("height", "gravity", "velocity_b", "hands_b", "camera_b", "delay")]
    command, turning = c["state"][:, spec.COMMAND_SLICE], c["state"][:, :3]
    cost = (c["action"] ** 2).mean(axis=1, keepdims=True)
    return _stack(*base, turning, command, c["action"], c["action"] ** 2, cost)


def _object(task: str, c: Columns) -> NDArray[np.floating]:
    """The thing, when it began to matter, and who has touched it."""
    over = happened(c)
    since: NDArray[np.float32] = np.where(over, c["since_event"], 0.0).astype(np.float32)
    parts = [c["time"], over, since, since.clip(max=1.0), c["object_active"] * over]
    parts += [c["object_there"], c["object_size"], c["object_b"].clip(-4, 4)]
    parts += [c["object_velocity_b"].clip(-8, 8), c["force"].clip(max=300.0)]
    parts += [c["touched_ticks"] > 0, c["since_touch"].clip(max=1.0)]
    if task != "ball":  # which has no front
        parts.append(c["object_ahead_b"])
    return _stack(*parts)


def _commanded_hands(c: Columns) -> NDArray[np.floating]:
    """(N, 6) where the action sends the hands, m, heading frame."""
    hands: NDArray[np.floating] = spec.ACTION_BOX.to_metric(c["action"])[:, :6]
    return hands


def _ball(c: Columns) -> NDArray[np.floating]:
    """When and where the ball crosses the plane of the hands, and how far they are from there."""
    position, velocity = c["object_b"], c["object_velocity_b"]
    speed = -velocity[:, :1]
    time = (position[:, :1] - PLANE) / np.maximum(speed, _SLOW)
    comes = (c["object_active"] > 0) & (speed > _SLOW) & (time > -0.1)
    time = time.clip(-0.1, 1.5)
    point = position + velocity * time
    point[:, 2:] -= _G / 2 * time**2
    point = np.concatenate([np.full_like(time, PLANE), point[:, 1:].clip(-1.5, 1.5)], axis=1)
    miss = [hands - np.tile(point, 2) for hands in (c["hands_b"], _commanded_hands(c))]
    aside = [np.linalg.norm(m.reshape(-1, 2, 3)[..., 1:], axis=-1) for m in miss]
    nearest = [a.min(axis=1, keepdims=True) for a in aside]
    told = _stack(time, point[:, 1:], *miss, *aside, *nearest)
    return _stack(comes, told * comes)


def _wall(c: Columns) -> NDArray[np.floating]:
    """Distances to the wall along its normal, the speed towards it, and who leans on it."""
    normal = c["object_ahead_b"]

    def gap(points: NDArray[np.floating]) -> NDArray[np.floating]:
        away = c["object_b"][:, None] - points.reshape(len(points), -1, 3)
        return np.asarray(np.einsum("npi,ni->np", away, normal))

    where = [gap(p) for p in (c["hands_b"], _commanded_hands(c), c["camera_b"], 0 * c["camera_b"])]
    speed = (c["velocity_b"] * normal).sum(axis=1, keepdims=True)
    braced = c["force"][:, :2].max(axis=1, keepdims=True) > _BRACE_FORCE
    leaning = c["force"][:, 2:].max(axis=1, keepdims=True) > 0
    tilt = -c["gravity"][:, 2:]
    return _stack(*where, speed, braced, leaning, braced & ~leaning, tilt)


def _arch(c: Columns) -> NDArray[np.floating]:
    """Where the arch is, how much room the head has, and whether the passage can still be clean."""
    ahead, active = c["object_b"][:, :1], c["object_active"]
    room = c["object_size"] - c["height"] - c["camera_b"][:, 2:]
    asked = c["object_size"] - spec.ACTION_BOX.to_metric(c["action"])[:, 6:]
    clean = c["touched_ticks"].sum(axis=1, keepdims=True) == 0
    speed = c["velocity_b"][:, :1] - c["object_velocity_b"][:, :1]
    going = np.maximum(speed, 0.1)
    left = ((ahead + 0.3) / going).clip(-3, 6)
    return _stack(ahead, abs(ahead), room, asked, clean, clean * active, speed, left, left * clean)
