"""Which low-level controller: by name, or by the file of a trained one."""

from __future__ import annotations

from pathlib import Path

from egovcp.errors import UsageError
from egovcp.robot.controller import LowLevelController
from egovcp.robot.stance import StanceController
from egovcp.robot.walk_onnx import OnnxPolicy
from egovcp.robot.walk_policy import WalkPolicy
from egovcp.robot.walking import WalkingController


def make_controller(which: str) -> LowLevelController:
    """``stance``, or the path of a ``walk.safetensors`` or of its export to ONNX.

    Raises:
        UsageError: neither.
        ArtefactError: the file cannot be used.
        EnvironmentFailure: onnxruntime is not installed.
    """
    if which == "stance":
        return StanceController()
    if which.endswith(".safetensors"):
        return WalkingController(WalkPolicy.load(Path(which)))
    if which.endswith(".onnx"):
        return WalkingController(OnnxPolicy(Path(which)))
    raise UsageError(
        f"unknown controller {which!r}; expected stance, or a file PATH.safetensors or PATH.onnx "
        "that egovcp-train-lowlevel wrote"
    )
