"""Design of the stance law: poses, reduced dynamics, gains. Offline; needs MuJoCo and SciPy.

With both feet planted the robot has few degrees of freedom left: the pelvis pose (6) and
the waist (3); the arms count as a fixed load. Write z (9) for these coordinates and T
(35, 9) for the map from their rates to the rates of the model (the legs follow from the
planted feet, T_leg = -J_leg^-1 J_pelvis). Then, with servo targets u of legs and waist,

    M_r z'' = T^T (kp (u - q) - kd q' - bias(q)),    M_r = T^T M T

is linearised at a static pose and discretised exactly to the controller's 20 ms. One tick
of actuation delay is part of the design: the state is x = [z - z0, z'] (18) and u_{k-1}.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from scipy.linalg import expm, solve_discrete_are

from egovcp.robot.arms import REST
from egovcp.robot.g1 import ARMS, DAMPING, STIFFNESS
from egovcp.robot.geometry import Array
from egovcp.robot.kinematics import ANKLE_HEIGHT, HALF_STANCE_WIDTH
from egovcp.robot.stance_table import NF, NR, NU, NX, NY, NZ
from egovcp.spec import CONTROLLER_HZ, NUM_JOINTS

_MOMENT_STEP: Final = 0.5  # kg m, of the difference quotient

FOOT_CENTRE: Final = 0.034  # m, middle of toe and heel points ahead of the ankle

#: Natural pelvis pitch (rad) against height (m): below 0.61 m the ankle's limit tips it.
PITCH_HEIGHTS: Final = (0.50, 0.55, 0.60, 0.64)
PITCHES: Final = (0.50, 0.34, 0.12, 0.0)

# Scales of the quadratic cost: m, rad, m/s, rad/s, N m.
_POSITION: Final = np.array([0.02, 0.02, 0.015, 0.04, 0.04, 0.06, 0.08, 0.08, 0.08])
_RATE: Final = np.array([0.3, 0.3, 0.3, 0.6, 0.6, 1.0, 1.0, 1.0, 1.0])
_LEG_TORQUE: Final = np.array([30.0, 30.0, 15.0, 30.0, 8.0, 5.0])
_WAIST_TORQUE: Final = np.array([15.0, 15.0, 15.0])
_TARGET_CHANGE: Final = 0.15  # rad per tick

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
#: Of the joint noise, at the ankles: feet rock on their edges.
_ANKLE_FACTOR: Final = 5.0


@dataclass(frozen=True)
class Pose:
    """A static two-feet stance: model coordinates and the servo torques that hold it."""

    qpos: Array  # (36,)
    torque: Array  # (15,) N m, legs and waist


class StanceModel:
    """The robot on two planted feet."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        self.feet = [model.body(f"{s}_ankle_roll_link").id for s in ("left", "right")]
        self.target = np.array([[0.0, s * HALF_STANCE_WIDTH, ANKLE_HEIGHT] for s in (1, -1)])

    def place(self, qpos: Array) -> None:
        """Set the configuration and compute positions, inertia and bias forces."""
        self.data.qpos[:] = qpos
        self.data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, self.data)

    def feet_jacobian(self) -> Array:
        """(12, 35): linear and angular velocity of both ankle-roll frames, world."""
        rows = []
        for foot in self.feet:
            linear, angular = np.zeros((2, 3, self.model.nv))
            mujoco.mj_jac(self.model, self.data, linear, angular, self.data.xpos[foot], foot)
            rows += [linear, angular]
        return np.concatenate(rows)

    def feet_error(self) -> Array:
        """(12,) how far both feet are from flat on their spots: metres and radians."""
        out = []
        for foot, target in zip(self.feet, self.target, strict=True):
            turn = np.zeros(3)
            mujoco.mju_quat2Vel(turn, self.data.xquat[foot], 1.0)
            out += [self.data.xpos[foot] - target, turn]
        return np.concatenate(out)

    def plant(self, qpos: Array) -> Array:
        """Solve the twelve leg joints so that both feet stand on their spots (Newton)."""
        q = qpos.copy()
        for _ in range(30):
            self.place(q)
            error = self.feet_error()
            if np.abs(error).max() < 1e-12:
                break
            step = np.linalg.solve(self.feet_jacobian()[:, 6:18], -error)
            q[7:19] += np.clip(step, -0.3, 0.3)
        return q

    def basis(self) -> Array:
        """T (35, 9) at the configuration last placed."""
        jac = self.feet_jacobian()
        basis = np.zeros((self.model.nv, NZ))
        basis[:6, :6] = np.eye(6)
        basis[6:18, :6] = -np.linalg.solve(jac[:, 6:18], jac[:, :6])
        basis[18:21, 6:] = np.eye(3)
        return basis

    def displaced(self, qpos: Array, z: Array) -> Array:
        """``qpos`` with pelvis and waist displaced by z (9) and the feet still planted."""
        velocity = np.zeros(self.model.nv)
        velocity[:6], velocity[18:21] = z[:6], z[6:]
        out = qpos.copy()
        mujoco.mj_integratePos(self.model, out, velocity, 1.0)
        return self.plant(out)

    def force(self, qpos: Array, target: Array) -> Array:
        """(9,) generalised force on z at rest, for servo targets (15,)."""
        self.place(qpos)
        torque = np.zeros(self.model.nv)
        torque[6:21] = STIFFNESS[:NU] * (target - qpos[7:22])
        return np.asarray(self.basis().T @ (torque - self.data.qfrc_bias))

    def inertia(self) -> Array:
        """(35, 35) mass matrix at the configuration last placed."""
        mass = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, mass)
        return mass

    def com(self) -> Array:
        """(3,) centre of mass at the configuration last placed, m."""
        out: Array = self.data.subtree_com[1].copy()
        return out


def pitch_at(height: float | Array) -> Array:
    """Natural pelvis pitch (rad) at a pelvis height (m)."""
    return np.asarray(np.interp(height, PITCH_HEIGHTS, PITCHES))


def upright(height: float, x: float, y: float = 0.0) -> Array:
    """Model coordinates with arms at rest, the pelvis at (x, y, height), knees bent a little."""
    pitch = float(pitch_at(height))
    qpos = np.zeros(7 + NUM_JOINTS)
    qpos[:7] = [x, y, height, np.cos(pitch / 2), 0.0, np.sin(pitch / 2), 0.0]
    qpos[7:][ARMS] = REST.ravel()
    bend = np.sqrt(max(0.8 - height, 0.0)) * 1.9
    qpos[[10, 16]] = bend
    qpos[[7, 13]] = -bend / 2 - pitch
    qpos[[11, 17]] = -bend / 2
    return qpos


def balanced_pose(stance: StanceModel, height: float) -> Pose:
    """The pose at a height whose centre of mass is over the middle of the feet."""
    x, y = 0.0, 0.0
    for _ in range(20):
        qpos = stance.plant(upright(height, x, y))
        com = stance.com()
        x += FOOT_CENTRE - com[0]
        y -= com[1]
    return Pose(qpos, holding_torque(stance))


def load_response(stance: StanceModel, pose: Pose, height: float) -> Array:
    """How the balanced pose answers a load that the arms carry off its place.

    Returns:
        (2, 32): change of [pelvis x, y (m), joints 15 (rad), torques 15 (N m)] per kg m of
        first moment that the arms add, forward and to the left (pelvis heading frame).
    """
    torso = stance.model.body("torso_link").id
    rest = stance.model.body_ipos[torso].copy()
    out = []
    for axis in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]):
        ends = []
        for sign in (1.0, -1.0):
            stance.place(pose.qpos)
            in_torso = stance.data.xmat[torso].reshape(3, 3).T @ np.array(axis)
            shift = sign * _MOMENT_STEP / stance.model.body_mass[torso]
            stance.model.body_ipos[torso] = rest + shift * in_torso
            moved = balanced_pose(stance, height)
            ends.append(np.concatenate([moved.qpos[:2], moved.qpos[7:22], moved.torque]))
            stance.model.body_ipos[torso] = rest
        out.append((ends[0] - ends[1]) / (2 * _MOMENT_STEP))
    return np.stack(out)


def holding_torque(stance: StanceModel) -> Array:
    """(15,) smallest torques (relative to each joint's stiffness) that hold the pose placed."""
    basis = stance.basis()
    weight = STIFFNESS[:NU]
    wanted = basis.T @ stance.data.qfrc_bias
    scaled = basis[6:21].T * weight
    return np.asarray(weight * np.linalg.lstsq(scaled, wanted, rcond=None)[0])


@dataclass(frozen=True)
class Linear:
    """Discrete dynamics of the planted robot around a pose, and what its sensors see."""

    a: Array  # (18, 18)
    b: Array  # (18, 15)
    c: Array  # (36, 18)
    force: Array  # (18, 9): x per constant generalised force on z (N, N m)
    legs: Array  # (15, 9): joint displacement per z
    torque_x: Array  # (15, 18): servo torque per x
    torque_u: Array  # (15, 15)
    rocking: Array  # (9, 2): z per roll and pitch of the whole robot on its feet's middle
    mobility: Array  # (9, 9): M_r^-1, rate of z per generalised impulse


def linearise(stance: StanceModel, pose: Pose) -> Linear:
    """Reduced dynamics at a pose, with an exact zero-order hold over one tick."""
    spring = _spring(stance, pose)
    stance.place(pose.qpos)
    basis = stance.basis()
    joints = basis[6:21]
    inverse = np.asarray(np.linalg.inv(basis.T @ stance.inertia() @ basis), dtype=np.float64)
    kp, kd = np.diag(STIFFNESS[:NU]), np.diag(DAMPING[:NU])
    inputs, forces = slice(NX, NX + NU), slice(NX + NU, NX + NU + NZ)
    rates = np.zeros((NX + NU + NZ, NX + NU + NZ))
    rates[:NZ, NZ:NX] = np.eye(NZ)
    rates[NZ:NX, :NZ] = inverse @ spring
    rates[NZ:NX, NZ:NX] = -inverse @ joints.T @ kd @ joints
    rates[NZ:NX, inputs] = inverse @ joints.T @ kp
    rates[NZ:NX, forces] = inverse
    discrete = expm(rates / CONTROLLER_HZ)
    return Linear(
        a=discrete[:NX, :NX],
        b=discrete[:NX, inputs],
        force=discrete[:NX, forces],
        c=sensor_matrix(pose, joints),
        legs=joints,
        torque_x=np.hstack([-kp @ joints, -kd @ joints]),
        torque_u=kp,
        rocking=rocking(pose),
        mobility=inverse,
    )


def _spring(stance: StanceModel, pose: Pose) -> Array:
    """(9, 9) derivative of the static force by z at constant targets, central differences."""
    target = pose.qpos[7:22] + pose.torque / STIFFNESS[:NU]
    step = 1e-4
    out = np.empty((NZ, NZ))
    for i, unit in enumerate(np.eye(NZ) * step):
        ahead = stance.force(stance.displaced(pose.qpos, unit), target)
        behind = stance.force(stance.displaced(pose.qpos, -unit), target)
        out[:, i] = (ahead - behind) / (2 * step)
    return out


def rocking(pose: Pose) -> Array:
    """(9, 2): displacement z when the robot rolls and pitches rigidly about its feet's middle."""
    forward, up = pose.qpos[0] - FOOT_CENTRE, pose.qpos[2]
    pitch = 2 * np.arctan2(pose.qpos[5], pose.qpos[3])
    out = np.zeros((NZ, 2))
    out[:6, 0] = [0.0, -up, 0.0, np.cos(pitch), 0.0, np.sin(pitch)]
    out[:6, 1] = [up, 0.0, -forward, 0.0, 1.0, 0.0]
    return out


def sensor_matrix(pose: Pose, joints: Array) -> Array:
    """C (36, 18): gravity turns by -phi x g for a body rotation phi; the rest is direct."""
    pitch = 2 * np.arctan2(pose.qpos[5], pose.qpos[3])
    gx, gz = np.sin(pitch), -np.cos(pitch)
    c = np.zeros((NY, NX))
    c[0:3, 3:6] = [[0, -gz, 0], [gz, 0, -gx], [0, gx, 0]]
    c[3:6, NZ + 3 : NZ + 6] = np.eye(3)
    c[6:21, :NZ] = joints
    c[21:36, NZ:] = joints
    return c


def lqr_gain(linear: Linear) -> tuple[Array, Array, Array]:
    """K_x (15, 18), K_d (15, 9) and K_u (15, 15) from one Riccati equation.

    The state is extended by constant forces d, for which the gain finds the cheapest posture, and
    by the delayed input w. Penalised are the servo torques T_x x + T_u w, not the targets.
    """
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

    The legs measure the pelvis relative to the soles, gravity and gyro absolutely; a decaying roll
    and pitch of the soles accounts for the difference. Slowly changing forces account for errors of
    the model.
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
    r = np.diag(measurement_noise() ** 2)
    process = np.diag(np.concatenate([_DRIFT, _PUSH, np.full(NR, _ROCK), _FORCE]) ** 2)
    p = solve_discrete_are(a.T, c.T, process, r)
    return np.asarray(np.linalg.solve(c @ p @ c.T + r, c @ p).T)


def measurement_noise() -> Array:
    """(36,) standard deviations in the order of ``sensor_matrix``."""
    ankle = np.ones(NU)
    ankle[[4, 5, 10, 11]] = _ANKLE_FACTOR
    imu = np.repeat([_GRAVITY_NOISE, _GYRO_NOISE], 3)
    return np.concatenate([imu, _JOINT_NOISE * ankle, _JOINT_RATE_NOISE * ankle])


def compensator(linear: Linear) -> Array:
    """M (44, 80): Kalman filter and LQR as one linear map per tick.

    In deviations from the reference pose, with measurement dy, servo targets du, and the last sent
    du, w_{k-1}, which acts now because of the tick of delay:

        x^ = x_ + L (dy - C x_)             estimate from the prediction x_
        du = -K_x x^ - K_u w_{k-1}          LQR on the state extended by the delayed input
        x_' = A x^ + B w_{k-1}              prediction for the next tick

    hence [du; x_'] = M [x_; dy; w_{k-1}].
    """
    k_x, k_d, k_u = lqr_gain(linear)
    k_x = np.hstack([k_x, np.zeros((NU, NR)), k_d])
    a, b, c = filter_model(linear)
    gain = kalman_gain(a, c)
    filtered = np.hstack([np.eye(NF) - gain @ c, gain, np.zeros((NF, NU))])
    delayed = np.hstack([np.zeros((NU, NF + NY)), np.eye(NU)])
    return np.vstack([-k_x @ filtered - k_u @ delayed, a @ filtered + b @ delayed])
