"""LQR and Kalman gains of the stance law, folded into one linear compensator per height.

The control law at tick k, in deviations from the reference pose (dy measurement, du servo
targets, w_{k-1} the du sent last, which acts now because of the tick of delay):

    x^ = x_ + L (dy - C x_)             estimate from the prediction x_
    du = -K_x x^ - K_u w_{k-1}          LQR on the state extended by the delayed input
    x_' = A x^ + B w_{k-1}              prediction for the next tick

All three are linear, so [du; x_'] = M [x_; dy; w_{k-1}] with one matrix M (44, 80).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.stance_design import Linear
from egovcp.robot.stance_table import NF, NR, NU, NX, NY, NZ

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
_FORCE: Final = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3])  # N, N m
_FORCE_DECAY: Final = 0.998
#: Feet rock on their edges: a planted *ankle* is believed, a flat foot hardly.
_ANKLE_FACTOR: Final = 5.0


def lqr_gain(linear: Linear) -> tuple[Array, Array, Array]:
    """K_x (15, 18), K_d (15, 9) and K_u (15, 15) from one Riccati equation.

    The state is extended by the constant forces d, so that the gain finds the posture and
    the torques that oppose them at least cost, and by the delayed input w. What is
    penalised is the torque that the servos make, T_x x + T_u w, not the targets.
    """
    from scipy.linalg import solve_discrete_are

    n = NX + NZ + NU
    delayed = slice(NX + NZ, n)
    a, b = np.zeros((n, n)), np.zeros((n, NU))
    a[:NX] = np.hstack([linear.a, linear.force, linear.b])
    a[NX : NX + NZ, NX : NX + NZ] = _FORCE_DECAY * np.eye(NZ)
    b[delayed] = np.eye(NU)
    torque = np.hstack([linear.torque_x, np.zeros((NU, NZ)), linear.torque_u])
    torque /= np.concatenate([_LEG_TORQUE, _LEG_TORQUE, _WAIST_TORQUE])[:, None]
    q = torque.T @ torque
    q[:NX, :NX] += np.diag(1.0 / np.concatenate([_POSITION, _RATE]) ** 2)
    # (u_k - u_{k-1})^2 couples the new target to the delayed one
    change = np.eye(NU) / _TARGET_CHANGE**2
    q[delayed, delayed] += change
    cross = np.zeros((n, NU))
    cross[delayed] = -change
    p = solve_discrete_are(a, b, q, change, s=cross)
    gain = np.linalg.solve(change + b.T @ p @ b, b.T @ p @ a + cross.T)
    return gain[:, :NX], gain[:, NX : NX + NZ], gain[:, delayed]


def filter_model(linear: Linear) -> tuple[Array, Array, Array]:
    """A (29, 29), B (29, 15) and C (36, 29): the states, rocking feet and forces.

    The legs measure the pelvis relative to the soles; gravity and gyro measure it truly.
    A rock of the soles (roll, pitch), fading by itself, explains the difference. Forces
    that change slowly explain what servos, masses and contacts do unlike the model.
    """
    a, b, c = np.zeros((NF, NF)), np.zeros((NF, NU)), np.zeros((NY, NF))
    rock, force = slice(NX, NX + NR), slice(NX + NR, NF)
    a[:NX, :NX], a[:NX, force], b[:NX] = linear.a, linear.force, linear.b
    a[rock, rock] = _ROCK_DECAY * np.eye(NR)
    a[force, force] = _FORCE_DECAY * np.eye(NZ)
    c[:, :NX] = linear.c
    c[6:21, rock] = -linear.legs @ linear.rocking
    return a, b, c


def kalman_gain(a: Array, c: Array) -> Array:
    """L (29, 36): steady-state measurement update, from the dual Riccati equation."""
    from scipy.linalg import solve_discrete_are

    r = np.diag(measurement_noise() ** 2)
    process = np.diag(np.concatenate([_DRIFT, _PUSH, np.full(NR, _ROCK), _FORCE]) ** 2)
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
    """M (44, 80) of the module's equation."""
    k_x, k_d, k_u = lqr_gain(linear)
    k_x = np.hstack([k_x, np.zeros((NU, NR)), k_d])
    a, b, c = filter_model(linear)
    gain = kalman_gain(a, c)
    filtered = np.hstack([np.eye(NF) - gain @ c, gain, np.zeros((NF, NU))])
    delayed = np.hstack([np.zeros((NU, NF + NY)), np.eye(NU)])
    return np.vstack([-k_x @ filtered - k_u @ delayed, a @ filtered + b @ delayed])
