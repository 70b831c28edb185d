"""What the runner needs of a robot, simulated or real."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import BasePose, CameraView, SceneObject


@dataclass(frozen=True)
class Sensed:
    """One observation o_t, and in simulation the truth beside it, for logs only."""

    depth: NDArray[np.uint16]
    """(48, 64) planar depth, mm, 0 invalid."""
    state: NDArray[np.float32]
    """(74,) proprioception in the layout of `spec.STATE_SLICES`."""
    base: BasePose | None = None
    scene: tuple[SceneObject, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What followed from an action; a real robot knows only what it was sent."""

    sent: NDArray[np.float64]
    """(7,) the action that took effect, box units."""
    reward: float = 0.0
    reward_terms: Mapping[str, float] = field(default_factory=dict)
    terminated: bool = False
    truncated: bool = False
    success: bool = False
    events: tuple[str, ...] = ()


class Robot(Protocol):
    """A robot with its low-level controller running, ready to take actions at 25 Hz."""

    @property
    def controller_id(self) -> str:
        """Identity of the low-level controller; an artifact drives only its data's."""
        ...

    @property
    def camera(self) -> CameraView:
        """Mount and field of view of the head camera, in the present episode."""
        ...

    def start(self, episode: int) -> None:
        """Begin rollout number ``episode`` in the neutral pose."""
        ...

    def observe(self) -> Sensed:
        """The newest observation."""
        ...

    def act(self, action: NDArray[np.float64]) -> Outcome:
        """Send an action (7,) that has passed the safety filter."""
        ...

    def damp(self) -> None:
        """Damp the motors until the next `start`, whatever is sent: a standing robot sinks."""
        ...

    def close(self) -> None:
        """Release what the robot holds; further calls do nothing."""
        ...
