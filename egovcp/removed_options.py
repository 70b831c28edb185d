"""Options of older versions that were removed or renamed, and what replaces them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

from egovcp.errors import UsageError

_TRACKER: Final = (
    "the ball tracker was removed and the world model learns from depth images alone: leave it out"
)
_HEADS: Final = "Q has one head, which reads the whole state: leave it out"
_POSE: Final = "all tasks share one pose cost: use --env.pose_cost"
_HIT: Final = "a touch of the body costs once: use --env.arch.hit_cost"
_NO_TERM: Final = "its reward term was removed: leave it out"
_WALL: Final = ("brace_reward", "upright_reward", "impact_cost", "impact_force", "guard_cost")
_ARCH: Final = ("progress_reward", "crouch_cost", "near")

#: Option of older versions -> its present name.
RENAMED_OPTIONS: Final[Mapping[str, str]] = {
    "policy.loss.moving": "policy.loss.motion_weight",
    "policy.loss.moving_threshold": "policy.loss.motion_threshold",
    "policy.loss.near": "policy.loss.proximity_weight",
    "policy.loss.near_threshold": "policy.loss.proximity_threshold",
    "policy.loss.foresight_depth": "policy.loss.multistep_depth",
    "policy.loss.foresight_state": "policy.loss.multistep_state",
    "policy.loss.foresight_ahead": "policy.loss.multistep_horizons",
    "policy.loss.foresight_every": "policy.loss.multistep_stride",
    "planner.process": "planner.action_parameterization",
    "robot.limits.picture_hold_s": "robot.limits.image_hold_s",
    "train.compared_steps": "train.steps",
    "curriculum.few_falls": "curriculum.low_fall_rate",
    "curriculum.many_falls": "curriculum.high_fall_rate",
}
#: Option, or group of options -> one sentence.
REMOVED_OPTIONS: Final[Mapping[str, str]] = {
    **dict.fromkeys(("passing", "policy.motion_ahead", "policy.paint_flight"), _TRACKER),
    **dict.fromkeys(("policy.value_of_passing", "policy.flight", "policy.loss.flight"), _TRACKER),
    **dict.fromkeys(("policy.loss.motion", "policy.loss.passing"), _TRACKER),
    "policy.loss.foresight_motion": _TRACKER,
    **dict.fromkeys(("policy.value_state", "policy.q_heads", "planner.ensemble"), _HEADS),
    "planner.hands_cost": (
        "the planner computes the cost of the pose in the reward: use --planner.pose_cost"
    ),
    "planner.step_cost": (
        "the planner computes the cost of action changes in the reward: use "
        "--planner.action_rate_cost"
    ),
    **dict.fromkeys(("backend", "ray"), "all processes run on this machine: leave it out"),
    "assets": "plots are written to assets/ beside the card: leave it out",
    "format": "egovcp-export writes weights in half precision only: leave it out",
    "operator.gamepad": "use the robot's remote control, or --operator.type=keyboard",
    "robot.bridge.consistency": "readings are always checked for consistency: leave it out",
    "train.max_minutes": "models are compared after equal steps: use --train.steps",
    "train.task_flags": "all tasks share one recipe: use --train.flags",
    "play.task_flags": "all tasks share one recipe: use --play.flags",
    "value_fit": "Q is trained with the world model and not fitted again afterwards: leave it out",
    "network.activation": "the networks of a controller have ELU units: leave it out",
    "policy.value_units": "the head of Q is as wide as every MLP: use --policy.units",
    "optimizer.value_replay": (
        "Q is fitted to a privileged value instead of single returns: leave it out"
    ),
    "sampling.event_fraction": (
        "windows are drawn uniformly: leave it out; --sampling.tasks weights whole tasks"
    ),
    "datasets.return_steps": "all datasets have one horizon of returns: use --returns.steps",
    **dict.fromkeys(("env.ball.pose_cost", "env.wall.pose_cost", "env.arch.pose_cost"), _POSE),
    "env.wall.contact_cost": "a touch of the body costs once: use --env.wall.hit_cost",
    **dict.fromkeys(("env.arch.contact_cost", "env.arch.head_cost"), _HIT),
    **dict.fromkeys((f"env.wall.{name}" for name in _WALL), _NO_TERM),
    **dict.fromkeys((f"env.arch.{name}" for name in _ARCH), _NO_TERM),
    "env.arch.motion": (
        "the robot always walks to the arch: leave it out, and use a controller that walks"
    ),
    "realtime": (
        "the simulator waits for the planner: leave it out, or start egovcp-fake-g1 and use "
        "--robot.type=unitree_g1 for a run on the wall clock"
    ),
    "return_steps": "Q is compared with the returns that it was trained on: leave it out",
}
#: Option that only some programs had -> these programs.
PROGRAMS: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(("backend", "ray"), ("egovcp-collect", "egovcp-experiment")),
    "assets": ("egovcp-dataset",),
    "format": ("egovcp-export",),
    "network.activation": ("egovcp-train-lowlevel",),
    "realtime": ("egovcp-deploy",),
    "return_steps": ("egovcp-eval-model",),
}
_INDEX: Final = re.compile(r"\[\d+\]")


class RemovedOptionError(UsageError):
    """An option of older versions."""


def refuse_removed_flag(flag: str, prog: str = "") -> None:
    """Raise `RemovedOptionError` if an unknown flag, or the group that contains it, was renamed, or
    removed from ``prog``; empty: from any program."""
    parts = _INDEX.sub("", flag.removeprefix("--")).split(".")
    for end in range(1, len(parts) + 1):
        name = ".".join(parts[:end])
        if new := RENAMED_OPTIONS.get(name):
            where = "; set it in a --config_path file" if new.startswith("policy.loss.") else ""
            raise RemovedOptionError(f"option {flag} was renamed to {new}{where}")
        programs = PROGRAMS.get(name) if prog else None
        if name in REMOVED_OPTIONS and (not programs or prog.split()[0] in programs):
            raise RemovedOptionError(f"option {flag} was removed: {REMOVED_OPTIONS[name]}")
