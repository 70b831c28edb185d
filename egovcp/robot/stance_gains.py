"""LQR and Kalman gains of the stance law, folded into one linear compensator per height.

The control law at tick k, in deviations from the reference pose (dy measurement, du servo
targets, w_{k-1} the du sent last, which acts now because of the tick of delay):

    x^ = x_ + L (dy - C x_)             estimate from the prediction x_
    du = -K_x x^ - K_u w_{k-1}          LQR on the state extended by the delayed input
    x_' = A x^ + B w_{k-1}              prediction for the next tick

All three are linear, so [du; x_'] = M [x_; dy; w_{k-1}] with one matrix M (35, 71).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.stance_design import Linear
from egovcp.robot.stance_table import NF, NU, NX, NY

Array = NDArray[np.float64]

# Cost: how far (m, rad, m/s, rad/s, N m) counts as much as one unit of anything else.
_POSITION: Final = np.array([0.02, 0.02, 0.015, 0.04, 0.04, 0.06, 0.08, 0.08, 0.08])
_RATE: Final = np.array([0.3, 0.3, 0.3, 0.6, 0.6, 1.0, 1.0, 1.0, 1.0])
_LEG_TORQUE: Final = np.array([30.0, 30.0, 15.0, 30.0, 8.0, 5.0])
_WAIST_TORQUE: Final = np.array([15.0, 15.0, 15.0])
_TARGET_CHANGE: Final = 0.15  # rad per tick: keeps the law away from the noise

# Noise of the estimator, per tick.
_PUSH: Final = np.array([0.05, 0.05, 0.05, 0.1, 0.1, 0.1, 0.3, 0.3, 0.3])  # on rates
_DRIFT: Final = np.array([1e-3, 1e-3, 1e-3, 2e-3, 2e-3, 2e-3, 4e-3, 4e-3, 4e-3])  # on z
_GRAVITY_NOISE: Final = 0.015
_GYRO_NOISE: Final = 0.08  # rad/s
_JOINT_NOISE: Final = 0.008  # rad
_JOINT_RATE_NOISE: Final = 0.4  # rad/s
_ROCK: Final = 0.01  # rad
_ROCK_DECAY: Final = 0.95
#: Feet rock on their edges: a planted *ankle* is believed, a flat foot hardly.
_ANKLE_FACTOR: Final = 5.0


def lqr_gain(linear: Linear) -> tuple[Array, Array]:
    """K_x (15, 18) and K_u (15, 15) for the delayed input, by the Riccati equation."""
    from scipy.linalg import solve_discrete_are

    n = NX + NU
    a, b = np.zeros((n, n)), np.zeros((n, NU))
    a[:NX, :NX], a[:NX, NX:] = linear.a, linear.b
    b[NX:] = np.eye(NU)
    torque = np.hstack([linear.torque_x, linear.torque_u])
    torque /= np.concatenate([_LEG_TORQUE, _LEG_TORQUE, _WAIST_TORQUE])[:, None]
    q = torque.T @ torque
    q[:NX, :NX] += np.diag(1.0 / np.concatenate([_POSITION, _RATE]) ** 2)
    # (u_k - u_{k-1})^2 couples the new target to the delayed one
    change = np.eye(NU) / _TARGET_CHANGE**2
    q[NX:, NX:] += change
    cross = np.zeros((n, NU))
    cross[NX:] = -change
    p = solve_discrete_are(a, b, q, change, s=cross)
    gain = np.linalg.solve(change + b.T @ p @ b, b.T @ p @ a + cross.T)
    return gain[:, :NX], gain[:, NX:]


def filter_model(linear: Linear) -> tuple[Array, Array, Array]:
    """A (20, 20), B (20, 15) and C (36, 20) with two states for feet that rock.

    The legs measure the pelvis relative to the soles; gravity and gyro measure it truly.
    A rock of the soles (roll, pitch), fading by itself, explains the difference.
    """
    a, b = np.zeros((NF, NF)), np.zeros((NF, NU))
    a[:NX, :NX], b[:NX] = linear.a, linear.b
    a[NX:, NX:] = _ROCK_DECAY * np.eye(2)
    legs = np.zeros((NY, 2))
    legs[6:21] = -linear.legs @ linear.rocking
    return a, b, np.hstack([linear.c, legs])


def kalman_gain(a: Array, c: Array) -> Array:
    """L (20, 36): steady-state measurement update, from the dual Riccati equation."""
    from scipy.linalg import solve_discrete_are

    r = np.diag(measurement_noise() ** 2)
    process = np.diag(np.concatenate([_DRIFT, _PUSH, [_ROCK, _ROCK]]) ** 2)
    p = solve_discrete_are(a.T, c.T, process, r)
    return np.asarray(np.linalg.solve(c @ p @ c.T + r, c @ p).T)


def measurement_noise() -> Array:
    """(36,) standard deviations in the order of ``stance_design.sensor_matrix``."""
    ankle = np.ones(NU)
    ankle[[4, 5, 10, 11]] = _ANKLE_FACTOR
    return np.concatenate(
        [
            np.full(3, _GRAVITY_NOISE),
            np.full(3, _GYRO_NOISE),
            _JOINT_NOISE * ankle,
            _JOINT_RATE_NOISE * ankle,
        ]
    )


def compensator(linear: Linear) -> Array:
    """M (35, 71) of the module's equation."""
    k_x, k_u = lqr_gain(linear)
    k_x = np.hstack([k_x, np.zeros((NU, 2))])
    a, b, c = filter_model(linear)
    gain = kalman_gain(a, c)
    filtered = np.hstack([np.eye(NF) - gain @ c, gain, np.zeros((NF, NU))])
    delayed = np.hstack([np.zeros((NU, NF + NY)), np.eye(NU)])
    return np.vstack([-k_x @ filtered - k_u @ delayed, a @ filtered + b @ delayed])
