"""Names, shapes, units and clock rates shared by all packages.

Axis letters in shapes; a module that uses others, or these for something else, explains them:

    B batch (episodes, environments or sequences)    T time (planner ticks)
    H depth rows (48)                                W depth columns (64)
    S proprioceptive state (74)                      A action (7)
    J joints (29)                                    M candidate plans
    N planning horizon                               P actions of a plan (`PlannerConfig.actions`)
    E robots, episodes or scenarios

Units are SI (metres, radians, seconds) unless a name says otherwise. Frames: a
suffix ``_w`` is the world, ``_b`` the pelvis *heading* frame (origin at the pelvis,
x forward, y left, z up, rotated by yaw only).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

SPEC_VERSION: Final = 1

type _Array = NDArray[np.float64]

# --- clock -----------------------------------------------------------------------
PLANNER_HZ: Final = 25
CONTROLLER_HZ: Final = 50
PHYSICS_DT: Final = 0.005  # s
CONTROLLER_TICKS_PER_PLAN: Final = CONTROLLER_HZ // PLANNER_HZ  # 2
PHYSICS_STEPS_PER_CONTROLLER_TICK: Final = round(1 / (CONTROLLER_HZ * PHYSICS_DT))  # 4
PLANNER_DT: Final = 1.0 / PLANNER_HZ  # s

# --- depth -----------------------------------------------------------------------
DEPTH_ROWS: Final = 48
DEPTH_COLS: Final = 64
DEPTH_MIN_M: Final = 0.28  # a D435i sees nothing nearer: closer surfaces read 0
DEPTH_MAX_M: Final = 5.0  # farther surfaces read 0 (invalid)
#: Default of the simulated camera: mount in the torso frame, m; downward tilt, rad, drawn per
#: episode; vertical field of view, rad.
CAMERA_POSITION: Final = (0.058, 0.0, 0.42)
CAMERA_PITCH_RANGE: Final = (math.radians(-15.0), math.radians(-10.0))
CAMERA_VERTICAL_FOV: Final = math.radians(58.0)

# --- robot -----------------------------------------------------------------------
JOINT_NAMES: Final = (
    "left_hip_pitch_joint",
    "left_hip_roll_joint",
    "left_hip_yaw_joint",
    "left_knee_joint",
    "left_ankle_pitch_joint",
    "left_ankle_roll_joint",
    "right_hip_pitch_joint",
    "right_hip_roll_joint",
    "right_hip_yaw_joint",
    "right_knee_joint",
    "right_ankle_pitch_joint",
    "right_ankle_roll_joint",
    "waist_yaw_joint",
    "waist_roll_joint",
    "waist_pitch_joint",
    "left_shoulder_pitch_joint",
    "left_shoulder_roll_joint",
    "left_shoulder_yaw_joint",
    "left_elbow_joint",
    "left_wrist_roll_joint",
    "left_wrist_pitch_joint",
    "left_wrist_yaw_joint",
    "right_shoulder_pitch_joint",
    "right_shoulder_roll_joint",
    "right_shoulder_yaw_joint",
    "right_elbow_joint",
    "right_wrist_roll_joint",
    "right_wrist_pitch_joint",
    "right_wrist_yaw_joint",
)
NUM_JOINTS: Final = len(JOINT_NAMES)

# --- proprioception: the layout of ``observation.state`` ---------------------------
STATE_SLICES: Final = {
    "angular_velocity": slice(0, 3),  # rad/s, pelvis IMU frame
    "projected_gravity": slice(3, 6),  # unit vector, pelvis IMU frame; upright = (0, 0, -1)
    "command_velocity": slice(6, 9),  # vx, vy (m/s), yaw rate (rad/s), heading frame
    "command_hands": slice(9, 15),  # left xyz, right xyz (m), heading frame
    "command_height": slice(15, 16),  # m, pelvis above ground
    "joint_position": slice(16, 45),  # rad, JOINT_NAMES order
    "joint_velocity": slice(45, 74),  # rad/s, JOINT_NAMES order
}
STATE_DIM: Final = 74
COMMAND_SLICE: Final = slice(6, 16)  # velocity 3, hands 6, height 1

STATE_NAMES: Final = (
    *(f"angular_velocity.{a}" for a in "xyz"),
    *(f"projected_gravity.{a}" for a in "xyz"),
    "command.vx",
    "command.vy",
    "command.yaw_rate",
    *(f"command.left_hand.{a}" for a in "xyz"),
    *(f"command.right_hand.{a}" for a in "xyz"),
    "command.height",
    *(f"{name}.pos" for name in JOINT_NAMES),
    *(f"{name}.vel" for name in JOINT_NAMES),
)

# --- action ----------------------------------------------------------------------
ACTION_NAMES: Final = (
    *(f"left_hand.{a}" for a in "xyz"),
    *(f"right_hand.{a}" for a in "xyz"),
    "height",
)
ACTION_DIM: Final = 7
ACTION_HANDS: Final = slice(0, 6)
# In normalised units ([-1, 1]):
ACTION_ETA: Final = 0.32  # largest step of the paper's random walk (section III-B), each tick
ACTION_RATE_LIMIT: Final = 0.32  # per planner tick; same in collection and deployment
#: Default random walk of egovcp-collect, which holds its targets: largest step, and planner ticks
#: from one step to the next (least, most). The low-level controller is trained on both walks.
HELD_ETA: Final = 1.0
HELD_TICKS: Final = (5, 15)


def reflect(action: NDArray[np.floating], low: NDArray[np.floating] | float = -1.0) -> _Array:
    """Reflect normalised actions into [low, 1] at the bounds."""
    width = 1.0 - low
    out: _Array = 1.0 - np.abs((action - low) % (2.0 * width) - width)
    return out


@dataclass(frozen=True)
class ActionBox:
    """The box that a normalised action in [-1, 1]^A spans, in SI units.

    The map is affine on each side of the neutral pose: -1 -> ``low``, 0 -> ``neutral``, 1 ->
    ``high``. So 0 is a pose to rest in, although the box may reach farther one way than the other.
    """

    low: tuple[float, ...]
    neutral: tuple[float, ...]
    high: tuple[float, ...]

    def to_metric(self, action: NDArray[np.floating]) -> NDArray[np.float64]:
        """Normalised action (..., A) in [-1, 1] -> SI units (..., A)."""
        a = np.asarray(action, dtype=np.float64)
        low, mid, high = (np.asarray(v) for v in (self.low, self.neutral, self.high))
        metric: NDArray[np.float64] = mid + np.where(a < 0, a * (mid - low), a * (high - mid))
        return metric

    def to_normalised(self, metric: NDArray[np.floating]) -> NDArray[np.float64]:
        """SI units (..., A) -> normalised action (..., A); the inverse of `to_metric`."""
        m = np.asarray(metric, dtype=np.float64)
        low, mid, high = (np.asarray(v) for v in (self.low, self.neutral, self.high))
        d = m - mid
        action: NDArray[np.float64] = np.where(d < 0, d / (mid - low), d / (high - mid))
        return action


#: Hand targets (palm sites) in the pelvis heading frame, then pelvis height above ground.
#: Neutral: arms hanging with slightly bent elbows, beside the hips. Shoulders are at
#: (0, +-0.15, 0.29) and a straight arm is 0.465 m, so x = 0.55 lies beyond reach: the arm
#: then stretches fully and can push. z = 0.50 is the head's height, z = -0.20 the thighs'.
ACTION_BOX: Final = ActionBox(
    low=(0.00, -0.08, -0.20, 0.00, -0.42, -0.20, 0.52),
    neutral=(0.12, 0.24, -0.10, 0.12, -0.24, -0.10, 0.74),
    high=(0.55, 0.42, 0.50, 0.55, 0.08, 0.50, 0.76),
)

# --- reward ----------------------------------------------------------------------
#: Reward terms in datasets; their sum is the reward. A task's own terms are stored in one of these:
#: a wanted contact, another achievement, an unwanted contact or state, and those of every task.
REWARD_TERMS: Final = ("block", "pass", "hit", "fall", "pose", "action_rate")
#: Terms that are functions of the actions alone: the planner computes them, Q learns the others.
ACTION_TERMS: Final = ("pose", "action_rate")
POSE_COST: Final = 0.02  # per planner tick, times the mean squared action; 0 in the neutral pose
#: Per planner tick, times the mean squared change of the action over `ACTION_RATE_LIMIT`.
ACTION_RATE_COST: Final = 0.05
#: Least change of the reward by an event, where the terms are not recorded: events count 1, the
#: costs of pose and action rate at most 0.07.
EVENT_REWARD: Final = 0.08


# --- scene -----------------------------------------------------------------------
@dataclass(frozen=True)
class Solid:
    """An object in the simulated scene, for logs."""

    name: str
    """Unique within the scene, such as ``wall``."""
    shape: Literal["sphere", "box"]
    size: tuple[float, float, float]
    """Half extents along its own axes, m; for a sphere three times the radius."""
    position_w: _Array
    """(3,) centre, m."""
    quaternion_w: _Array
    """(4,) rotation to the world frame, wxyz."""


# --- LeRobot feature names ---------------------------------------------------------
DEPTH_KEY: Final = "observation.images.ego_depth"
STATE_KEY: Final = "observation.state"
ACTION_KEY: Final = "action"
REWARD_KEY: Final = "next.reward"
DONE_KEY: Final = "next.done"
SUCCESS_KEY: Final = "next.success"
TRUNCATED_KEY: Final = "next.truncated"
REWARD_TERMS_KEY: Final = "reward_terms"
OBJECT_KEY: Final = "privileged.object"  # of the simulator: trained on, never an input of a policy
#: Position of the task's object (m, heading frame), and whether it is known (1) or zeros (0).
OBJECT_NAMES: Final = ("x", "y", "z", "known")
OBJECT_DIM: Final = len(OBJECT_NAMES)
#: In the features of `egovcp.data.privileged`: position (m) in the heading frame of the object when
#: it was last known, its rate there (m/s), and whether it is known now.
OBJECT_STATE: Final = slice(0, 6)
OBJECT_KNOWN: Final = 6
CONTROLLER_ID_KEY: Final = "controller_id"  # of the low-level controller, in LeRobot's `info`

#: LeRobot feature descriptions of the columns egovcp adds to the standard ones.
FEATURES: Final[dict[str, dict[str, object]]] = {
    DEPTH_KEY: {
        "dtype": "image",
        "shape": (DEPTH_ROWS, DEPTH_COLS, 1),
        "names": ["height", "width", "channels"],
        "info": {"is_depth_map": True},
    },
    STATE_KEY: {"dtype": "float32", "shape": (STATE_DIM,), "names": list(STATE_NAMES)},
    ACTION_KEY: {
        "dtype": "float32",
        "shape": (ACTION_DIM,),
        "names": list(ACTION_NAMES),
    },
    REWARD_KEY: {"dtype": "float32", "shape": (1,), "names": None},
    DONE_KEY: {"dtype": "bool", "shape": (1,), "names": None},
    SUCCESS_KEY: {"dtype": "bool", "shape": (1,), "names": None},
    TRUNCATED_KEY: {"dtype": "bool", "shape": (1,), "names": None},
    REWARD_TERMS_KEY: {
        "dtype": "float32",
        "shape": (len(REWARD_TERMS),),
        "names": list(REWARD_TERMS),
    },
    OBJECT_KEY: {"dtype": "float32", "shape": (OBJECT_DIM,), "names": list(OBJECT_NAMES)},
}
#: Columns that datasets of earlier versions lack; they are read as zeros.
OPTIONAL_KEYS: Final = (REWARD_TERMS_KEY, OBJECT_KEY)

# --- defaults of `ReturnConfig` (paper, equation 9) -----------------------------------
GAMMA: Final = 0.97
RETURN_STEPS: Final = 16
