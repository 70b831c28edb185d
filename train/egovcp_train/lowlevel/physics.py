"""Many robots on a floor, stepped in threads by `mujoco.rollout`; their states as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import mujoco
import numpy as np
from mujoco.rollout import Rollout
from numpy.typing import NDArray

from egovcp.robot.mjcf import FootModel, robot_spec
from egovcp.robot.stance_table import NU, standing_pose
from egovcp.sim.scene import FLOOR, strip_visuals
from egovcp.sim.tasks.wall import WALL, add_wall
from egovcp.spec import ACTION_BOX, CONTROLLER_HZ, JOINT_NAMES, PHYSICS_DT
from egovcp_train.lowlevel.config import DisturbanceConfig

Array = NDArray[np.float64]
HEAD: Final = "head_collision"  # a sphere
NO_WALL: Final = (1000.0, 0.0, 0.0)
"""m, position of a wall out of reach."""
_WALL_FRICTION: Final = (0.5, 1.0)
_STATE: Final = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CONTROL: Final = int(
    mujoco.mjtState.mjSTATE_CTRL
    | mujoco.mjtState.mjSTATE_MOCAP_POS
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)
#: Sensors of each side: position, velocity and x axis of the foot, position of the palm.
_SENSORS: Final = (
    ("ankle_roll_link", mujoco.mjtSensor.mjSENS_FRAMEPOS),
    ("ankle_roll_link", mujoco.mjtSensor.mjSENS_FRAMELINVEL),
    ("ankle_roll_link", mujoco.mjtSensor.mjSENS_FRAMEXAXIS),
    ("palm", mujoco.mjtSensor.mjSENS_FRAMEPOS),
)


@dataclass(frozen=True)
class PhysicsOptions:
    """Options of MuJoCo; the defaults are those of training."""

    timestep: float = PHYSICS_DT
    """s; a divisor of a controller tick of 20 ms."""
    integrator: Literal["implicitfast", "implicit", "Euler"] = "implicitfast"
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"

    @property
    def steps_per_tick(self) -> int:
        """Physics steps per controller tick."""
        return round(1 / (CONTROLLER_HZ * self.timestep))

    def apply(self, spec: mujoco.MjSpec) -> None:
        """Set the options of ``spec``."""
        spec.option.timestep = self.timestep
        spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{self.integrator.upper()}")
        spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{self.cone.upper()}")


@dataclass(frozen=True)
class Snapshot:
    """The true state of N robots, world frame; feet and palms as of one physics step before."""

    position: Array  # (N, 3) pelvis, m
    quaternion: Array  # (N, 4) pelvis, wxyz
    velocity: Array  # (N, 3) pelvis, m/s
    angular_velocity: Array  # (N, 3) rad/s, pelvis frame
    joints: Array  # (N, J) rad
    joint_rates: Array  # (N, J) rad/s
    feet: Array  # (N, 2, 3) ankle-roll frames, m
    feet_velocity: Array  # (N, 2, 3) m/s
    feet_forward: Array  # (N, 2, 3) x axes
    palms: Array  # (N, 2, 3) m
    torque: Array  # (N, J) N m, of the motors
    head_top: Array  # (N,) m
    broken: NDArray[np.bool_]  # (N,) the simulation diverged


class BatchPhysics:
    """N robots; robot i has the physical parameters of model i modulo the number of models."""

    def __init__(
        self,
        robots: int,
        feet: FootModel,
        config: DisturbanceConfig,
        threads: int,
        seed: int,
        options: PhysicsOptions | None = None,
    ) -> None:
        self.options = options or PhysicsOptions()
        base = compile_model(feet, self.options)
        rng = np.random.default_rng(seed)
        pool = [_randomised(base, config, rng) for _ in range(min(robots, config.models))]
        self._models = [pool[i % len(pool)] for i in range(robots)]
        self._data = [mujoco.MjData(base) for _ in range(max(1, threads))]
        self._rollout = Rollout(nthread=threads if threads > 1 else 0)
        self.state = np.zeros((robots, mujoco.mj_stateSize(base, _STATE)))
        self._nq, self._nv = base.nq, base.nv
        self._head_radius = float(base.geom(HEAD).size[0])
        steps = self.options.steps_per_tick
        self._states = np.zeros((robots, steps, self.state.shape[1]))
        self._readings = np.zeros((robots, steps, base.nsensordata))
        self._control = np.zeros((robots, steps, mujoco.mj_stateSize(base, _CONTROL)))
        self._nu = base.nu
        self.set_walls(np.tile(np.asarray(NO_WALL), (robots, 1)), np.zeros(robots))
        self._warm = np.zeros((robots, base.nv))
        self._target = np.zeros((robots, base.nu))
        self._previous = np.zeros((robots, base.nu))  # targets of the tick before
        self.floor_friction = np.array([m.geom_friction[_feet(m)[0], 0] for m in self._models])

    @property
    def qpos(self) -> Array:
        """(N, 36) pelvis position and quaternion, joints; a view to write to."""
        return self.state[:, 1 : 1 + self._nq]

    @property
    def qvel(self) -> Array:
        """(N, 35) pelvis velocity (world) and rates (pelvis frame), joint rates; a view."""
        return self.state[:, 1 + self._nq : 1 + self._nq + self._nv]

    def place(self, rows: NDArray[np.intp], qpos: Array, target: Array) -> None:
        """Put robots at rest at ``qpos``, with joint targets ``target``."""
        self.state[rows] = 0.0
        self.qpos[rows] = qpos
        self._target[rows] = self._previous[rows] = target

    def set_walls(self, position: Array, yaw: Array) -> None:
        """Place the walls: position (N, 3) m of the surface, yaw (N,) rad of the normal into it."""
        self._control[:, :, self._nu : self._nu + 3] = position[:, None]
        quaternion = self._control[:, :, self._nu + 3 :]
        quaternion[..., 0] = np.cos(yaw / 2)[:, None]
        quaternion[..., 3] = np.sin(yaw / 2)[:, None]

    def step(self, target: Array, delay: NDArray[np.intp]) -> None:
        """One controller tick.

        Args:
            target: (N, J) joint targets, rad.
            delay: (N,) physics steps after which they act, at most two ticks.
        """
        steps = self._control.shape[1]
        for k in range(steps):
            last = np.where((k + steps < delay)[:, None], self._previous, self._target)
            self._control[:, k, : self._nu] = np.where((k < delay)[:, None], last, target)
        self._previous, self._target = self._target, target.copy()
        self._rollout.rollout(
            self._models,
            self._data,
            self.state,
            self._control,
            control_spec=_CONTROL,
            skip_checks=True,
            nstep=self._control.shape[1],
            initial_warmstart=self._warm,
            state=self._states,
            sensordata=self._readings,
        )
        self.state[:] = self._states[:, -1]

    def snapshot(self) -> Snapshot:
        """The state now; of a robot just placed, feet, palms and torques are of the step before."""
        qpos, qvel = self.qpos, self.qvel
        readings = self._readings[:, -1, : 3 * 2 * len(_SENSORS)]
        feet, speed, forward, palms = np.moveaxis(readings.reshape(-1, len(_SENSORS), 2, 3), 1, 0)
        torque = self._readings[:, -1, 3 * 2 * len(_SENSORS) : -3]
        broken = ~np.isfinite(self.state).all(axis=1)
        broken |= np.abs(qvel).max(axis=1) > 100.0
        return Snapshot(
            position=qpos[:, :3],
            quaternion=qpos[:, 3:7],
            velocity=qvel[:, :3],
            angular_velocity=qvel[:, 3:6],
            joints=qpos[:, 7:],
            joint_rates=qvel[:, 6:],
            feet=feet,
            feet_velocity=speed,
            feet_forward=forward,
            palms=palms,
            torque=torque,
            head_top=self._readings[:, -1, -1] + self._head_radius,
            broken=broken,
        )

    def close(self) -> None:
        """End the threads."""
        self._rollout.close()


def compile_model(feet: FootModel, options: PhysicsOptions | None = None) -> mujoco.MjModel:
    """The robot on a floor with a wall, and the sensors that `BatchPhysics` reads."""
    spec = robot_spec(feet)
    (options or PhysicsOptions()).apply(spec)
    strip_visuals(spec)
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    spec.worldbody.add_geom(
        name=FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=0
    )
    add_wall(spec)
    for name, kind in _SENSORS:
        for side in ("left", "right"):
            on_site = name == "palm"
            spec.add_sensor(
                type=kind,
                objtype=mujoco.mjtObj.mjOBJ_SITE if on_site else mujoco.mjtObj.mjOBJ_XBODY,
                objname=f"{side}_{name}",
            )
    for joint in JOINT_NAMES:
        spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_ACTUATORFRC,
            objtype=mujoco.mjtObj.mjOBJ_ACTUATOR,
            objname=joint,
        )
    spec.add_sensor(
        type=mujoco.mjtSensor.mjSENS_FRAMEPOS, objtype=mujoco.mjtObj.mjOBJ_GEOM, objname=HEAD
    )
    # MuJoCo must not reset a robot whose simulation diverges.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.visual.global_.bvactive = 0  # bounding volumes for display take 5 to 10 % of the time
    return spec.compile()


def _feet(model: mujoco.MjModel) -> list[int]:
    return [i for i in range(model.ngeom) if "_foot" in model.geom(i).name]


def _randomised(
    base: mujoco.MjModel, config: DisturbanceConfig, rng: np.random.Generator
) -> mujoco.MjModel:
    """A copy of ``base`` with random physical parameters; the gains differ by joint."""
    model = mujoco.MjModel.__copy__(base)
    model.geom_friction[_feet(model), 0] = rng.uniform(*config.friction)
    scale = rng.uniform(*config.mass_scale)
    model.body_mass[1:] *= scale
    model.body_inertia[1:] *= scale
    torso = model.body("torso_link").id
    model.body_mass[torso] += rng.uniform(*config.payload)
    stiffness = rng.uniform(*config.stiffness_scale, model.nu)
    model.actuator_gainprm[:, 0] *= stiffness
    model.actuator_biasprm[:, 1] *= stiffness
    model.actuator_biasprm[:, 2] *= rng.uniform(*config.damping_scale, model.nu)
    model.geom(WALL).friction[0] = rng.uniform(*_WALL_FRICTION)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


# --- initial states ------------------------------------------------------------------
_ARM_NOISE: Final = 0.1  # rad


def neutral_qpos(n: int) -> Array:
    """(n, 36) pelvis position and quaternion, joints: at the neutral height, facing along x."""
    pose = standing_pose(ACTION_BOX.neutral[-1])
    return np.tile(np.concatenate([pose.position, pose.quaternion, pose.joints]), (n, 1))


def random_qpos(n: int, rng: np.random.Generator) -> Array:
    """(n, 36) as `neutral_qpos`, with a random heading and noise on the arm joints."""
    qpos, quaternion = neutral_qpos(n), standing_pose(ACTION_BOX.neutral[-1]).quaternion
    yaw = rng.uniform(-np.pi, np.pi, n) / 2  # half the angle, as in a quaternion
    pitch = np.arctan2(quaternion[2], quaternion[0])  # likewise
    qpos[:, 3:7] = np.stack(
        [
            np.cos(yaw) * np.cos(pitch),
            -np.sin(yaw) * np.sin(pitch),
            np.cos(yaw) * np.sin(pitch),
            np.sin(yaw) * np.cos(pitch),
        ],
        axis=1,
    )
    arms = qpos[:, 7 + NU :]
    arms += rng.uniform(-_ARM_NOISE, _ARM_NOISE, arms.shape)
    return qpos


def random_delays(
    n: int, config: DisturbanceConfig, rng: np.random.Generator, timestep: float = PHYSICS_DT
) -> NDArray[np.intp]:
    """(n,) physics steps of ``timestep`` s after which new joint targets act."""
    low, high = (round(seconds / timestep) for seconds in config.delay)
    return rng.integers(low, high + 1, n)
