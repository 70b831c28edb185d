"""A planar arm of three joints on a table, with position servos and a depth camera above it."""

import math

import mujoco
import numpy as np

from egovcp.sim.tasks import ActionBox, Array, Mirror, MujocoRobot, RobotSpec

JOINTS = ("shoulder", "elbow", "wrist")
LENGTHS = (0.20, 0.16, 0.12)  # m
HEIGHT = 0.10  # m, of the arm above the table
LIMIT = (1.4, 1.8, 1.8)  # rad, of the targets of the servos
CAMERA = (0.22, 0.0, 0.70)  # m, above the middle of the reach
NOISE_M = 0.004  # std of depth
ENCODER_RAD = 0.002  # std of joint angles


class PlanarArm(MujocoRobot):
    """Its actions are the targets of the servos; it is symmetric about the x axis."""

    spec = RobotSpec(
        robot_type="planar_arm",
        depth=(32, 32),
        depth_max_m=0.75,
        planner_hz=20,
        state_names=(
            *(f"joint_position.{joint}" for joint in JOINTS),  # rad
            *(f"joint_velocity.{joint}" for joint in JOINTS),  # rad/s
            *(f"command.{joint}" for joint in JOINTS),  # rad
            *(f"tip.{axis}" for axis in "xyz"),  # m, base frame
        ),
        action_names=JOINTS,
        action_box=ActionBox(
            low=tuple(-x for x in LIMIT), neutral=(0.0, 0.0, 0.0), high=LIMIT
        ),  # rad
        mirror=Mirror(
            state_source=tuple(range(12)),
            state_sign=(*[-1.0] * 9, 1.0, -1.0, 1.0),
            action_source=(0, 1, 2),
            action_sign=(-1.0, -1.0, -1.0),
        ),
    )
    control_id = "planar-arm-servo-1"

    @classmethod
    def build(cls) -> mujoco.MjSpec:
        """Table, camera, and a chain of links in the plane z = HEIGHT, straight along x."""
        spec = mujoco.MjSpec()
        spec.option.timestep = 0.005
        spec.option.gravity = (0.0, 0.0, 0.0)  # the servos carry the arm
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1], contype=0)
        # image: columns to the right are -y, so that mirroring it left to right maps y to -y
        spec.worldbody.add_camera(
            name=cls.camera, pos=CAMERA, fovy=75.0, xyaxes=[0, -1, 0, 1, 0, 0]
        )
        parent = spec.worldbody
        at = [0.0, 0.0, HEIGHT]
        for joint, length in zip(JOINTS, LENGTHS, strict=True):
            link = parent.add_body(name=f"{joint}_link", pos=at)
            link.add_joint(name=joint, axis=[0, 0, 1], damping=0.02, armature=0.01)
            link.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, length, 0, 0],
                size=[0.015, 0, 0], density=400, contype=0, conaffinity=0,
            )  # fmt: skip
            servo = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=8.0, kv=0.8)
            parent, at = link, [length, 0.0, 0.0]
        parent.add_site(name="tip", pos=at)
        return spec

    @property
    def tip(self) -> Array:
        """(3,) position of the tip, m; the base frame is the world."""
        position: Array = self.data.site("tip").xpos.copy()
        return position

    def state(self) -> Array:
        """(12,) proprioception; the measured positions have noise."""
        angles = self.data.qpos[:3] + self.rng.normal(0.0, ENCODER_RAD, 3)
        heading = np.cumsum(angles)
        x, y = float(np.cos(heading) @ LENGTHS), float(np.sin(heading) @ LENGTHS)
        return np.concatenate([angles, self.data.qvel[:3], self.data.ctrl, [x, y, HEIGHT]])

    def depth(self) -> np.ndarray:
        """(32, 32) planar depth, mm, with noise."""
        exact = super().depth()
        noise = self.rng.normal(0.0, 1000.0 * NOISE_M, exact.shape)
        noisy = np.clip(exact + noise, 1, 1000 * self.spec.depth_max_m)
        return np.where(exact > 0, noisy, 0).round().astype(np.uint16)


def inverse_kinematics(x: float, y: float) -> Array:
    """(3,) joint angles, rad, that bring the tip to (x, y): the last two links bend alike."""
    best, least_error = np.zeros(3), math.inf
    for bend in np.linspace(-1.7, 1.7, 341):  # one degree of freedom is left: elbow = wrist
        angles = np.array([0.0, bend, bend])
        heading = np.cumsum(angles)
        px, py = float(np.cos(heading) @ LENGTHS), float(np.sin(heading) @ LENGTHS)
        angles[0] = math.atan2(y, x) - math.atan2(py, px)
        angles[0] = (angles[0] + math.pi) % (2 * math.pi) - math.pi
        error = abs(math.hypot(px, py) - math.hypot(x, y)) + max(0.0, abs(angles[0]) - LIMIT[0])
        if error < least_error:
            best, least_error = angles, error
    return best
