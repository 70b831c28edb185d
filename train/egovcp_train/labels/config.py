"""Geometry of the camera, and what counts as a throw."""

from __future__ import annotations

import math
from dataclasses import dataclass

from egovcp import spec
from egovcp.bounds import bounded


@dataclass(frozen=True)
class PassingConfig:
    """Geometry of the camera, and what counts as a throw."""

    plane: float = bounded(0.32, above=0)
    """The plane, before the pelvis, m."""
    camera_position: tuple[float, float, float] = (0.058, 0.0, 0.42)
    """Mount in the torso frame, m (the simulator's default)."""
    camera_pitch: float = math.radians(-2.5)
    """Tilt below the torso's horizontal, rad (the middle of the simulator's range)."""
    vertical_fov: float = bounded(math.radians(58.0), above=0, below=math.pi)
    """Vertical field of view, rad."""
    picture_ages: tuple[float, ...] = bounded((0.5, 1.0, 1.5, 2.0), least=0)
    """How much older than the state beside it a picture may be, planner ticks; the age of an
    episode's pictures is the one under which its sightings best lie on a path."""
    radius: float = bounded(0.10, least=0)
    """What is added to the depth of a surface to reach the middle of the thing, m."""
    min_sightings: int = bounded(4, least=2, most=100_000)
    """A path needs this many sightings."""
    tolerance: float = bounded(0.05, above=0)
    """Distance of a sighting from its path, per metre of its own distance, m."""
    min_speed: float = bounded(1.5, least=0)
    """What comes more slowly is not thrown, m/s."""
    max_speed: float = bounded(8.0, above=0)
    """What comes faster is a mistake, m/s."""
    max_offset: float = bounded(1.0, above=0)
    """A path that passes farther to the side or in height is a mistake, m."""

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return spec.DEPTH_ROWS / 2 / math.tan(self.vertical_fov / 2)
