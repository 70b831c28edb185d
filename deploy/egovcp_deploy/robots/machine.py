"""The variants of the G1 by the mode machine that they report.

Restates the table of ``robots/g1_description/README.md`` in unitreerobotics/unitree_ros. The
number tells the hardware: a robot whose waist is locked by its fastener, and by the switch in
Unitree's app that belongs to it, reports another one than the same robot with a free waist.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Machine:
    """One variant."""

    joints: int
    """Motors that are fitted: 29, 23 (waist yaw only, no wrist pitch and yaw), or 14 (arms)."""
    waist_locked: bool = False
    """Whether waist roll and pitch are fixed and must not be commanded."""
    hip_pitch_gear: float = 14.3
    """The gains and limits in `egovcp.robot.g1` are for 14.3."""


#: Mode machine -> variant. 1 to 3 are withdrawn versions.
MACHINES: Final[dict[int, Machine]] = {
    1: Machine(23),
    2: Machine(29),
    3: Machine(29, waist_locked=True),
    4: Machine(23),
    5: Machine(29),
    6: Machine(29, waist_locked=True),
    9: Machine(14),
    10: Machine(23, hip_pitch_gear=22.5),
    11: Machine(29, hip_pitch_gear=22.5),
    12: Machine(29, waist_locked=True, hip_pitch_gear=22.5),
    13: Machine(29),
    14: Machine(29, waist_locked=True),
    15: Machine(29, hip_pitch_gear=22.5),
    16: Machine(29, waist_locked=True, hip_pitch_gear=22.5),
}
FREE_WAIST: Final = tuple(
    mode for mode, machine in MACHINES.items() if machine.joints == 29 and not machine.waist_locked
)


def objection(mode: int, confirmed: bool) -> str:
    """Why a robot that reports ``mode`` must not be driven by our controllers; empty: it may.

    Both low-level controllers command all 29 joints, the waist among them.

    Args:
        mode: its mode machine.
        confirmed: the user has named this mode, and takes responsibility for a locked waist.
    """
    machine = MACHINES.get(mode)
    if machine is None:
        return ""
    if machine.joints != 29:
        return (
            f"mode machine {mode} is a G1 with {machine.joints} joints; the controller commands "
            "29: use a robot that has them"
        )
    if machine.waist_locked and not confirmed:
        return (
            f"mode machine {mode} is a G1 whose waist is locked, and the controller balances with "
            "waist roll and pitch: remove the fastener and switch the waist lock off in Unitree's "
            f"app, or accept it with --robot.bridge.mode={mode}"
        )
    return ""


def describe(mode: int) -> str:
    """A mode machine in words."""
    machine = MACHINES.get(mode)
    if machine is None:
        return warning(mode)
    waist = "waist locked" if machine.waist_locked else "waist free"
    words = f"mode machine {mode}: {machine.joints} joints, {waist}"
    note = _note(machine)
    return f"{words}; warning: {note}" if note else words


def warning(mode: int) -> str:
    """What the operator should know of a robot that reports ``mode``; empty: nothing."""
    machine = MACHINES.get(mode)
    if machine is None:
        known = ", ".join(map(str, FREE_WAIST))
        return (
            f"mode machine {mode} is not known: whether the robot has 29 joints and a free waist "
            f"(as {known} do) is not checked"
        )
    note = _note(machine)
    return f"mode machine {mode}: {note}" if note else ""


def _note(machine: Machine) -> str:
    """How a variant differs from the one that the controllers are made for; empty: not."""
    if machine.waist_locked:
        return (
            "the waist is locked, the controller's targets for waist roll and pitch have no "
            "effect, and its balance is untested without them"
        )
    if machine.hip_pitch_gear != Machine(29).hip_pitch_gear:
        return (
            f"the hip pitch gear is {machine.hip_pitch_gear}, the gains are for "
            f"{Machine(29).hip_pitch_gear}; untested"
        )
    return ""
