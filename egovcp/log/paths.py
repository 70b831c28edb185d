"""Entity paths of the Rerun log."""

from __future__ import annotations

from typing import Final

WORLD: Final = "/world"
ROBOT: Final = "/world/robot"  # one entity per link beneath
SKELETON: Final = "/world/skeleton"
SCENE: Final = "/world/scene"  # one entity per object beneath
CAMERA: Final = "/world/camera"
DEPTH: Final = "/world/camera/depth"
HAND_TARGETS: Final = "/world/hand_targets"
CANDIDATES: Final = "/world/candidates"
BEST: Final = "/world/plan"
RECONSTRUCTED: Final = "/depth/reconstructed"
IMAGINED: Final = "/depth/imagined"  # one entity per number of IMAGINED_TICKS beneath
IMAGINED_TICKS: Final = (4, 8, 16)  # how far ahead the shown images are imagined
PLAN: Final = "/plan"
VALUE_MAP: Final = "/value_map"  # one entity per hand beneath
CHOSEN: Final = "chosen"  # below a value map: the planned hand target
REWARD: Final = "/reward"
TIMING: Final = "/timing"
EVENTS: Final = "/events"
MOTOR_TORQUE: Final = "/motors/torque"  # one entity per limb beneath
MOTOR_TEMPERATURE: Final = "/motors/temperature"  # same
MOTOR_FAULTS: Final = "/motors/faults"  # one entity per joint that has had a fault
LINK: Final = "/link"  # one entity per figure of the connection
RUNNER: Final = "/runner"  # one entity per state, 0 or 1
INFO: Final = "/info"
ACTION: Final = "/action"  # one entity per group of signals beneath
STATE: Final = "/state"  # same
OUTCOME: Final = "/outcome"  # done and success, 0 or 1
