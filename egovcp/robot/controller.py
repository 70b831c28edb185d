"""The interface between the planner's command and the robot's joints.

A low-level controller tracks the command c = [v, p_ee, h_body] of the paper (section
III-A) from proprioception alone: exactly what a real G1 measures, never simulator truth.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class LowLevelController(Protocol):
    """Tracks the command inside the observation; batched over robots, 50 Hz."""

    @property
    def id(self) -> str:
        """Identity of law and numbers; datasets of different ids never mix."""
        ...

    @property
    def walks(self) -> bool:
        """Whether it follows the velocity part of the command."""
        ...

    @property
    def stepping(self) -> NDArray[np.bool_]:
        """(B,) which robots were taking steps in the last `step`."""
        ...

    @property
    def stiffness(self) -> NDArray[np.float64]:
        """(J,) proportional gains that the joint servos must run, N m/rad."""
        ...

    @property
    def damping(self) -> NDArray[np.float64]:
        """(J,) derivative gains that the joint servos must run, N m s/rad."""
        ...

    def reset(self, state: NDArray[np.floating], rows: NDArray[np.intp] | None = None) -> None:
        """Forget all memory of the given rows (default: every row) and start at ``state``.

        Args:
            state: (B, 74) observations in the layout of ``spec.STATE_SLICES``, all rows.
            rows: indices of the rows to reset; None resets the batch size too.
        """
        ...

    def step(self, state: NDArray[np.floating]) -> NDArray[np.float64]:
        """(B, 74) observations -> (B, 29) joint position targets, rad, ``JOINT_NAMES`` order.

        Gravity feed-forward is folded into the target (divided by the stiffness), so that
        a plain PD servo with ``stiffness`` and ``damping`` realises it.
        """
        ...
