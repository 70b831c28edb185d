"""Which low-level controller: by name, or by the file of a trained one."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path
from typing import Final

from egovcp.errors import UsageError
from egovcp.robot.controller import LowLevelController
from egovcp.robot.stance import StanceController
from egovcp.robot.walk_onnx import OnnxPolicy
from egovcp.robot.walk_policy import WalkPolicy
from egovcp.robot.walking import WalkingController

STANCE: Final = "stance"
WALK: Final = "walk"
_SHIPPED: Final = "g1_walk.safetensors"


def is_controller_file(which: str) -> bool:
    """Whether a controller is named by a file, not as ``stance`` or ``walk``."""
    return which.endswith((".safetensors", ".onnx"))


def absolute_controller(which: str) -> str:
    """The name of a controller that means the same in any working directory."""
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
    if which.endswith(".safetensors"):
        return WalkPolicy.load(Path(os.path.expanduser(which)))
    raise UsageError(f"no trained network {which!r}; expected walk or PATH.safetensors")


def make_controller(which: str) -> LowLevelController:
    """``stance``, ``walk``, or the path of a ``walk.safetensors`` or of its export to ONNX.

    ``stance`` is the LQR, ``walk`` the trained controller that the package ships.

    Raises:
        UsageError: neither.
        ArtifactError: the file cannot be used.
        EnvironmentFailure: onnxruntime is not installed.
    """
    if which == STANCE:
        return StanceController()
    if which == WALK or which.endswith(".safetensors"):
        return WalkingController(load_walk_policy(which))
    if which.endswith(".onnx"):
        return WalkingController(OnnxPolicy(Path(os.path.expanduser(which))))
    raise UsageError(
        f"unknown controller {which!r}; expected stance, walk, or a file PATH.safetensors or "
        "PATH.onnx that egovcp-train-lowlevel wrote"
    )
