"""What the simulator knows of a task: the object, and which rewards were already paid.

Together with proprioception it nearly determines what can be expected of an action, so a value
function is fitted to it (`egovcp.model.privileged_value`). No policy has it as an input.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp import spec

_EVENTS: Final = [i for i, name in enumerate(spec.REWARD_TERMS) if name not in spec.ACTION_TERMS]
_OLDEST_S: Final = 2.0
DIM: Final = 8 + len(_EVENTS)
"""Position (3) when the object was last known, m; its rate (3) then, m/s; whether it is known now;
seconds since then, at most 2; sums (4) of the earlier rewards of the episode for each term but
those of `spec.ACTION_TERMS`. The rate is that of the position in the moving heading frame: of the
object relative to the robot, also while the robot turns."""
_SIGN: Final = np.array([1, -1, 1, 1, -1, 1, *[1] * (DIM - 6)], np.float32)


def privileged_features(
    obj: NDArray[np.floating], reward_terms: NDArray[np.floating], hz: int = spec.PLANNER_HZ
) -> NDArray[np.float32]:
    """Features (T, `DIM`) of an episode, heading frame.

    Args:
        obj: (T, 4) position of the object, m, and whether it is known.
        reward_terms: (T, 6) of each row's action.
        hz: rows per second.
    """
    rows, known = np.arange(len(obj)), obj[:, 3] > 0
    velocity = np.zeros((len(obj), 3))
    velocity[1:] = (obj[1:, :3] - obj[:-1, :3]) * hz
    velocity[1:] *= (known[1:] & known[:-1])[:, None]
    last = np.maximum.accumulate(np.where(known, rows, -1))
    was_known = (last >= 0)[:, None]
    age = np.where(last >= 0, np.minimum((rows - last) * (1.0 / hz), _OLDEST_S), _OLDEST_S)
    events = np.zeros((len(obj), len(_EVENTS)))
    events[1:] = np.cumsum(reward_terms[:-1, _EVENTS], 0)
    columns = (obj[last, :3] * was_known, velocity[last] * was_known, known, age, events)
    return np.column_stack(columns).astype(np.float32)


def mirror_privileged[F: np.floating](features: NDArray[F]) -> NDArray[F]:
    """Reflected features (..., `DIM`), see `RobotSpec.mirror`."""
    return np.asarray(features * _SIGN.astype(features.dtype))
