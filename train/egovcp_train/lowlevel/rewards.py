"""Reward terms of the low-level policy, (N,) per second each; `RewardConfig` weights them."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.arms import DT
from egovcp.robot.g1 import EFFORT_LIMIT
from egovcp.robot.geometry import rotation_matrix
from egovcp.robot.stance_table import NU
from egovcp.robot.walking import Walk
from egovcp_train.lowlevel.physics import Snapshot
from egovcp_train.lowlevel.sensing import (
    TorsoMotion,
    heading,
    standing_feet,
    to_heading_xy,
)

Array = NDArray[np.float64]
_AVERAGE_S: Final = 0.3
_STANDING_SPEED: Final = 0.05  # m/s and rad/s, below which a command means standing
_MIN_WIDTH: Final = 0.16  # m between the feet, across
_MAX_ROTATION: Final = 10.0  # rad^2/s^2, bound of the terms of the torso's rotation
_FALLEN_TILT: Final = 0.8  # rad off the natural pitch
_FALLEN_HEIGHT: Final = 0.2  # m below the height's reference
#: Squared errors at which a term falls to 1 / e.
_VELOCITY_SCALE: Final = 0.03  # m^2/s^2
_TURNING_SCALE: Final = 0.1  # rad^2/s^2
_HEIGHT_SCALE: Final = 0.001  # m^2
_UPRIGHT_SCALE: Final = 0.03  # of the vertical, a unit vector
_WALKING_GAIT: Final = 0.5  # amount of gait above which feet must swing
_SWING: Final = 0.25  # sine of the phase above which a foot must swing


class AverageVelocity:
    """Velocity and turning, averaged because the pelvis swings with each step."""

    def __init__(self, robots: int) -> None:
        self.value = np.zeros((robots, 3))  # m/s ahead and across, rad/s

    def reset(self, rows: NDArray[np.intp]) -> None:
        """Set the average of ``rows`` to zero."""
        self.value[rows] = 0.0

    def add(self, x: Snapshot) -> None:
        """Adds a tick of 20 ms."""
        forward = heading(rotation_matrix(x.quaternion))
        now = np.concatenate(
            [to_heading_xy(x.velocity, forward), x.angular_velocity[:, 2:]], axis=1
        )
        self.value += DT / _AVERAGE_S * (np.nan_to_num(now) - self.value)


def terms(
    x: Snapshot,
    motion: Array,
    command: Array,
    walk: Walk,
    action: Array,
    last_action: Array,
    torso: TorsoMotion,
    pushed: NDArray[np.bool_],
) -> dict[str, Array]:
    """All terms except the fall.

    Args:
        x: the true state.
        motion: (N, 3) m/s ahead and across, rad/s of turning, averaged (`AverageVelocity`).
        command: (N, 10) v, hands, height.
        walk: the controller, for the pelvis' height and natural pitch, and the gait.
        action: (N, 15) of the policy.
        last_action: (N, 15) of the tick before.
        torso: its angular velocity, including this tick.
        pushed: (N,) whether a push was so recent that steps cost nothing.
    """
    height, pitch, gait = walk.height, walk.pitch, walk.gait.blend
    rotation = rotation_matrix(x.quaternion)
    forward = heading(rotation)
    up = rotation[:, 2]  # the world's vertical in the pelvis frame
    tilt_error = np.stack([up[:, 0] + np.sin(pitch), up[:, 1], up[:, 2] - np.cos(pitch)], axis=1)
    in_contact = standing_feet(x)
    feet = to_heading_xy(x.feet - x.position[:, None], forward)
    foot_forward = to_heading_xy(x.feet_forward, forward)
    width = feet[:, 0, 1] - feet[:, 1, 1]
    torque = x.torque[:, :NU] / EFFORT_LIMIT[:NU]
    velocity_error = np.sum((motion[:, :2] - command[:, :2]) ** 2, axis=1)
    slipping = np.sum(x.feet_velocity[..., :2] ** 2, axis=-1) * in_contact
    return {
        "alive": np.ones(len(height)),
        "velocity": np.exp(-velocity_error / _VELOCITY_SCALE),
        "turning": np.exp(-((motion[:, 2] - command[:, 2]) ** 2) / _TURNING_SCALE),
        "height": np.exp(-((x.position[:, 2] - height) ** 2) / _HEIGHT_SCALE),
        "upright": np.exp(-np.sum(tilt_error**2, axis=1) / _UPRIGHT_SCALE),
        "contact": _feet_in_phase(in_contact, walk.gait.phase, gait),
        "stepping": gait * (np.abs(command[:, :3]).max(axis=1) < _STANDING_SPEED) * ~pushed,
        "torso_rate": np.minimum(_torso_rate_error_sq(torso.rate, command), _MAX_ROTATION),
        "torso_change": np.minimum(np.sum(torso.change**2, axis=1), _MAX_ROTATION),
        "slip": np.sum(np.minimum(slipping, 4.0), axis=1),
        "stance_width": np.maximum(_MIN_WIDTH - width, 0.0),
        "foot_heading": np.sum(foot_forward[..., 1] ** 2, axis=1),
        "action": np.sum(action**2, axis=1),
        "action_rate": np.sum((action - last_action) ** 2, axis=1),
        "torque": np.mean(torque**2, axis=1),
    }


def fallen(x: Snapshot, height: Array, pitch: Array) -> NDArray[np.bool_]:
    """(N,) whether tilt or height are far off the reference, or the simulation diverged."""
    up = rotation_matrix(x.quaternion)[:, 2]
    cosine = up[:, 2] * np.cos(pitch) - up[:, 0] * np.sin(pitch)
    low = x.position[:, 2] < height - _FALLEN_HEIGHT
    out: NDArray[np.bool_] = (cosine < np.cos(_FALLEN_TILT)) | low | x.broken
    return out


def finite_terms(
    values: dict[str, Array], fell: NDArray[np.bool_], broken: NDArray[np.bool_]
) -> dict[str, Array]:
    """The ``values`` of `terms` and the ``fall``, all finite; 0 for a robot whose simulation
    diverged."""
    finite = {name: np.where(broken, 0.0, np.nan_to_num(v)) for name, v in values.items()}
    return finite | {"fall": fell.astype(np.float64)}


def _torso_rate_error_sq(rate: Array, command: Array) -> Array:
    """(N,) rad^2/s^2, squared error of the torso's angular velocity; commanded: yaw rate only."""
    rate_error = rate.copy()
    rate_error[:, 2] -= command[:, 2]
    return np.asarray(np.sum(rate_error**2, axis=1))


def _feet_in_phase(in_contact: NDArray[np.bool_], phase: Array, gait: Array) -> Array:
    """Share of the feet that stand or swing as the phase requires; without a gait, all stand."""
    swing = np.stack([np.sin(phase), -np.sin(phase)], axis=1) * gait[:, None]
    either = np.abs(swing) < _SWING
    either &= gait[:, None] > _WALKING_GAIT
    in_phase = np.where(either, True, in_contact == (swing < _SWING))
    return np.asarray(np.mean(in_phase, axis=1))
