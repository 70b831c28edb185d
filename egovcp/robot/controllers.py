"""Low-level controllers: the interface between commands and joints, and choice by name or file."""

from __future__ import annotations

import os
from importlib import resources
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import UsageError
from egovcp.files import user_path
from egovcp.robot.stance import StanceController
from egovcp.robot.walk_policy import WalkPolicy
from egovcp.robot.walking import WalkingController

STANCE: Final = "stance"
WALK: Final = "walk"
_SHIPPED: Final = "g1_walk.safetensors"


class LowLevelController(Protocol):
    """Tracks the command c = [v, p_ee, h_body] in the observation; batched over robots, 50 Hz.

    It reads proprioception only, as a real G1 measures it (section III-A of the paper). The joint
    servos must run the gains ``g1.STIFFNESS`` and ``g1.DAMPING``.
    """

    @property
    def id(self) -> str:
        """Identity of the control law and its numbers; datasets with different ids never mix."""
        ...

    @property
    def walks(self) -> bool:
        """Whether it follows the velocity part of the command."""
        ...

    @property
    def stepping(self) -> NDArray[np.bool_]:
        """(B,) which robots were taking steps in the last `step`."""
        ...

    def reset(self, state: NDArray[np.floating], rows: NDArray[np.intp] | None = None) -> None:
        """Reset the internal state of ``rows`` to the measured posture.

        Args:
            state: (B, 74) observations in the layout of ``spec.STATE_SLICES``, all rows.
            rows: indices of the rows to reset; None resets the batch size too.
        """
        ...

    def step(self, state: NDArray[np.floating]) -> NDArray[np.float64]:
        """(B, 74) observations -> (B, 29) joint position targets, rad, ``JOINT_NAMES`` order.

        Gravity feed-forward torques are part of the targets, divided by the stiffness.
        """
        ...


def is_controller_file(which: str) -> bool:
    """Whether ``which`` is the path of a controller's file."""
    return which.endswith(".safetensors")


def absolute_controller(which: str) -> str:
    """``which``, as an absolute path if it is a file."""
    return os.path.abspath(os.path.expanduser(which)) if is_controller_file(which) else which


def load_walk_policy(which: str) -> WalkPolicy:
    """The trained network of ``walk``, or of a ``walk.safetensors``.

    Raises:
        UsageError: neither.
        ArtifactError: the file cannot be used.
    """
    if which == WALK:
        with resources.as_file(resources.files("egovcp.robot").joinpath(_SHIPPED)) as path:
            return WalkPolicy.load(path)
    if is_controller_file(which):
        return WalkPolicy.load(user_path(which))
    raise UsageError(f"no trained network {which!r}; expected walk or PATH.safetensors")


def make_controller(which: str) -> LowLevelController:
    """The controller ``which``: ``stance`` (LQR), ``walk`` (trained, shipped), or the path of a
    ``walk.safetensors``.

    Raises:
        UsageError: neither.
        ArtifactError: the file cannot be used.
    """
    if which == STANCE:
        return StanceController()
    if which == WALK or is_controller_file(which):
        return WalkingController(load_walk_policy(which))
    raise UsageError(
        f"unknown controller {which!r}; expected stance, walk, or a file PATH.safetensors that "
        "egovcp-train-lowlevel wrote"
    )
