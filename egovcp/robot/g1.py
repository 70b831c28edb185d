"""The Unitree G1 (29 joints): model file, actuator constants and servo gains.

Actuator numbers are those of ``g1_constants.py`` in the mjlab wheel (Apache-2.0): rotor inertias,
gear stages, effort and velocity limits. Arrays are (J,) in the order of ``spec.JOINT_NAMES``.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure
from egovcp.packages import require_packages
from egovcp.spec import JOINT_NAMES

Array = NDArray[np.float64]

_XML: Final = Path("asset_zoo/robots/unitree_g1/xmls/g1.xml")


def model_path() -> Path:
    """Path of ``g1.xml`` inside the installed mjlab wheel, found without importing mjlab.

    Raises:
        EnvironmentFailure: mjlab is not installed, or its wheel lacks the model.
    """
    require_packages("egovcp", "the G1 model", "mjlab")
    found = importlib.util.find_spec("mjlab")
    if found is None or found.origin is None:
        raise EnvironmentFailure("the package mjlab has no location; install it again")
    path = Path(found.origin).parent / _XML
    if not path.is_file():
        raise EnvironmentFailure(
            f"expected the G1 model at {path}, found no such file; "
            "install mjlab 1.6: pip install 'mjlab>=1.6,<1.7'"
        )
    return path


@dataclass(frozen=True)
class Motor:
    """One motor type: rotor inertia and those of the two gear stages' carriers (kg m^2), limits."""

    rotor_inertia: tuple[float, float, float]
    gear: tuple[float, float]
    effort_limit: float  # N m
    velocity_limit: float  # rad/s

    @property
    def armature(self) -> float:
        """Inertia seen at the joint, I0 (g1 g2)^2 + I1 g2^2 + I2, kg m^2."""
        first, second = self.gear
        i0, i1, i2 = self.rotor_inertia
        return i0 * (first * second) ** 2 + i1 * second**2 + i2


M5020: Final = Motor((0.139e-4, 0.017e-4, 0.169e-4), (1 + 46 / 18, 1 + 56 / 16), 25.0, 37.0)
M7520_14: Final = Motor((0.489e-4, 0.098e-4, 0.533e-4), (4.5, 1 + 48 / 22), 88.0, 32.0)
M7520_22: Final = Motor((0.489e-4, 0.109e-4, 0.738e-4), (4.5, 5.0), 139.0, 20.0)
M4010: Final = Motor((0.068e-4, 0.0, 0.0), (5.0, 5.0), 5.0, 22.0)

#: Joint name without side and `_joint` -> motor type, number of motors, gains (kp N m/rad, kd N m
#: s/rad; None: the published ones). Arms have higher gains than the published ones, with which the
#: hands lag 6-8 cm behind the random walk. Ankles and the roll and pitch of the waist are four-bar
#: linkages with two motors, taken as 1:1.
_ACTUATORS: Final[dict[str, tuple[Motor, int, tuple[float, float] | None]]] = {
    "hip_pitch": (M7520_14, 1, None),
    "hip_roll": (M7520_22, 1, None),
    "hip_yaw": (M7520_14, 1, None),
    "knee": (M7520_22, 1, None),
    "ankle_pitch": (M5020, 2, None),
    "ankle_roll": (M5020, 2, None),
    "waist_yaw": (M7520_14, 1, None),
    "waist_roll": (M5020, 2, None),
    "waist_pitch": (M5020, 2, None),
    "shoulder_pitch": (M5020, 1, (80.0, 5.0)),
    "shoulder_roll": (M5020, 1, (80.0, 5.0)),
    "shoulder_yaw": (M5020, 1, (60.0, 3.0)),
    "elbow": (M5020, 1, (60.0, 3.0)),
    "wrist_roll": (M5020, 1, (30.0, 1.5)),
    "wrist_pitch": (M4010, 1, (20.0, 1.0)),
    "wrist_yaw": (M4010, 1, (20.0, 1.0)),
}

_NATURAL_FREQUENCY: Final = 10.0 * 2.0 * math.pi  # rad/s
_DAMPING_RATIO: Final = 2.0


def joint_kind(joint: str) -> str:
    """``left_hip_pitch_joint`` -> ``hip_pitch``."""
    return joint.removesuffix("_joint").removeprefix("left_").removeprefix("right_")


def _read_only(values: Iterable[float]) -> Array:
    array = np.array(list(values))
    array.setflags(write=False)
    return array


def _gains(published: Array, number: int) -> Array:
    """(J,) gain ``number`` of each joint in `_ACTUATORS`, or the published one."""
    pairs = zip(_JOINTS, published, strict=True)
    return _read_only(gain if own is None else own[number] for (_, _, own), gain in pairs)


_JOINTS: Final = [_ACTUATORS[joint_kind(name)] for name in JOINT_NAMES]
ARMATURE: Final = _read_only(motor.armature * count for motor, count, _ in _JOINTS)  # kg m^2
EFFORT_LIMIT: Final = _read_only(motor.effort_limit * count for motor, count, _ in _JOINTS)  # N m
VELOCITY_LIMIT: Final = _read_only(motor.velocity_limit for motor, *_ in _JOINTS)  # rad/s
#: Published servo gains: 10 Hz natural frequency on the armature, damping ratio 2.
PUBLISHED_STIFFNESS: Final = _read_only(ARMATURE * _NATURAL_FREQUENCY**2)  # N m/rad
PUBLISHED_DAMPING: Final = _read_only(
    2.0 * _DAMPING_RATIO * ARMATURE * _NATURAL_FREQUENCY
)  # N m s/rad
#: The gains in use: published ones in legs and waist, stiffer arms.
STIFFNESS: Final = _gains(PUBLISHED_STIFFNESS, 0)  # N m/rad
DAMPING: Final = _gains(PUBLISHED_DAMPING, 1)  # N m s/rad

WAIST: Final = slice(12, 15)
ARMS: Final = slice(15, 29)
