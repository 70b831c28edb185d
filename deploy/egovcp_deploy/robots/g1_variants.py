"""Variants of the G1 by the mode machine (``mode_machine``) that they report.

The table is that of ``robots/g1_description/README.md`` in unitreerobotics/unitree_ros. A robot
whose waist is locked, by its fastener and by the switch in Unitree's app, reports another number
than the same robot with a free waist.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class G1Variant:
    """Hardware of one variant."""

    joints: int
    """Number of motors: 29, 23 (waist yaw only, no wrist pitch and yaw), or 14 (arms)."""
    waist_locked: bool = False
    """Whether waist roll and pitch are fixed and must not be commanded."""
    hip_pitch_gear: float = 14.3
    """The gains and limits in `egovcp.robot.g1` are for 14.3."""


#: Mode machine -> variant. 1 to 3 are withdrawn versions.
VARIANTS: Final[dict[int, G1Variant]] = {
    1: G1Variant(23),
    2: G1Variant(29),
    3: G1Variant(29, waist_locked=True),
    4: G1Variant(23),
    5: G1Variant(29),
    6: G1Variant(29, waist_locked=True),
    9: G1Variant(14),
    10: G1Variant(23, hip_pitch_gear=22.5),
    11: G1Variant(29, hip_pitch_gear=22.5),
    12: G1Variant(29, waist_locked=True, hip_pitch_gear=22.5),
    13: G1Variant(29),
    14: G1Variant(29, waist_locked=True),
    15: G1Variant(29, hip_pitch_gear=22.5),
    16: G1Variant(29, waist_locked=True, hip_pitch_gear=22.5),
}
_FREE_WAIST: Final = ", ".join(
    str(mode) for mode, v in VARIANTS.items() if v.joints == 29 and not v.waist_locked
)


def variant_refusal(mode: int, confirmed: bool) -> str:
    """Why our controllers must not drive a robot that reports ``mode``; empty: they may.

    Both low-level controllers command all 29 joints, including the waist.

    Args:
        mode: its mode machine.
        confirmed: the user has named this mode and accepts a locked waist.
    """
    variant = VARIANTS.get(mode)
    if variant is None:
        return ""
    if variant.joints != 29:
        return (
            f"mode machine {mode} is a G1 with {variant.joints} joints; the controller commands "
            "29: use a robot that has them"
        )
    if variant.waist_locked and not confirmed:
        return (
            f"mode machine {mode} is a G1 whose waist is locked, and the controller balances with "
            "waist roll and pitch: remove the fastener and switch the waist lock off in Unitree's "
            f"app, or accept it with --robot.bridge.mode={mode}"
        )
    return ""


def describe_variant(mode: int) -> str:
    """Describe a mode machine in one line."""
    variant = VARIANTS.get(mode)
    if variant is None:
        return variant_warning(mode)
    waist = "waist locked" if variant.waist_locked else "waist free"
    text = f"mode machine {mode}: {variant.joints} joints, {waist}"
    difference = _difference(variant)
    return f"{text}; warning: {difference}" if difference else text


def variant_warning(mode: int) -> str:
    """Warning for the operator of a robot that reports ``mode``; empty: none."""
    variant = VARIANTS.get(mode)
    if variant is None:
        return (
            f"mode machine {mode} is not known: whether the robot has 29 joints and a free waist "
            f"(as {_FREE_WAIST} do) is not checked"
        )
    difference = _difference(variant)
    return f"mode machine {mode}: {difference}" if difference else ""


def _difference(variant: G1Variant) -> str:
    """How a variant differs from the one that the controllers are made for; empty: not at all."""
    if variant.waist_locked:
        return (
            "the waist is locked, the controller's targets for waist roll and pitch have no "
            "effect, and its balance is untested without them"
        )
    if variant.hip_pitch_gear != G1Variant.hip_pitch_gear:
        return (
            f"the hip pitch gear is {variant.hip_pitch_gear}, the gains are for "
            f"{G1Variant.hip_pitch_gear}; untested"
        )
    return ""
