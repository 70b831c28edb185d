"""What a log says before its first tick: the task, the config, versions and hashes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.geometry import focal_length
from egovcp.spec import DEPTH_COLS, DEPTH_ROWS, FEATURES, PLANNER_HZ, SPEC_VERSION


@dataclass(frozen=True)
class CameraView:
    """A pinhole depth camera fixed to a link, looking along that link's x axis."""

    link: str = "torso_link"
    position: tuple[float, float, float] = (0.06, 0.0, 0.43)
    """Optical centre in the link frame, m."""
    pitch: float = math.radians(3.0)
    """Downward tilt of the optical axis, rad."""
    vertical_fov: float = math.radians(58.0)
    """Angle between the top and the bottom edge of the picture, rad."""

    @property
    def focal_px(self) -> float:
        """Focal length, pixels."""
        return focal_length(self.vertical_fov)

    @property
    def centre_px(self) -> tuple[float, float]:
        """Principal point (column, row): the middle of the picture."""
        return DEPTH_COLS / 2, DEPTH_ROWS / 2

    @property
    def rotation(self) -> NDArray[np.float64]:
        """(3, 3) optical axes (x right, y down, z forward) as columns in the link frame."""
        c, s = math.cos(self.pitch), math.sin(self.pitch)
        return np.array([[0.0, -s, c], [-1.0, 0.0, 0.0], [0.0, -c, -s]])


@dataclass(frozen=True)
class RunInfo:
    """The first record of every log. Nothing in it is needed to read the ticks."""

    task: str
    seed: int = 0
    episode: int = 0
    fps: int = PLANNER_HZ
    camera: CameraView = CameraView()
    config: Mapping[str, object] = field(default_factory=dict)
    """Resolved configuration of the run; JSON values."""
    hashes: Mapping[str, str] = field(default_factory=dict)
    """Identities: artifact files, low-level controller, dataset."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Distribution name -> version."""
    backend: str = ""
    """Who computed the plans, such as int8 or float32; empty: nobody, or it is not known."""

    def to_metadata(self) -> dict[str, str]:
        """Flat strings for an MCAP metadata record; structured values are JSON."""
        record = asdict(self) | {"features": FEATURES, "spec_version": SPEC_VERSION}
        return {
            key: value if isinstance(value, str) else json.dumps(value, sort_keys=True)
            for key, value in record.items()
        }

    @staticmethod
    def from_metadata(record: Mapping[str, str]) -> RunInfo:
        """The inverse of `to_metadata`."""
        camera = json.loads(record["camera"])
        return RunInfo(
            task=record["task"],
            seed=int(record["seed"]),
            episode=int(record["episode"]),
            fps=int(record["fps"]),
            camera=CameraView(**camera | {"position": tuple(camera["position"])}),
            config=json.loads(record["config"]),
            hashes=json.loads(record["hashes"]),
            versions=json.loads(record["versions"]),
            backend=record.get("backend", ""),  # recordings of before do not say
        )
