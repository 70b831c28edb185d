"""Which low-level controller: by name, or by the file of a trained one."""

from __future__ import annotations

from pathlib import Path

from egovcp.errors import UsageError
from egovcp.robot.controller import LowLevelController
from egovcp.robot.stance import StanceController
from egovcp.robot.walk_policy import WalkPolicy
from egovcp.robot.walking import WalkingController


def make_controller(which: str) -> LowLevelController:
    """``stance``, or the path of a ``walk.safetensors``.

    Raises:
        UsageError: neither.
        ArtefactError: the file cannot be used.
    """
    if which == "stance":
        return StanceController()
    if which.endswith(".safetensors"):
        return WalkingController(WalkPolicy.load(Path(which)))
    raise UsageError(
        f"unknown controller {which!r}; expected stance, or a file PATH.safetensors that "
        "egovcp-train-lowlevel wrote"
    )
