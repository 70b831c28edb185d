"""The value maps of one robot's plan, for the log."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.log.tick import Hand, ValueMap
from egovcp.plan import hand_grid, value_map
from egovcp.plan.objective import Dynamics
from egovcp.plan.value_map import HAND_AXES
from egovcp.spec import ACTION_BOX

HANDS: Final[tuple[Hand, ...]] = ("left", "right")


def value_maps[L](
    model: Dynamics[L], carry: L, action: NDArray[np.floating]
) -> tuple[ValueMap, ...]:
    """Q of the planned action with each hand moved over its box; one robot.

    Args:
        model: the world model.
        carry: its filtered state (1, ...), before it advances.
        action: (7,) the planned action.
    """
    planned = torch.as_tensor(action, dtype=torch.float32, device=model.min_return.device)
    target = ACTION_BOX.to_metric(np.asarray(action))
    maps = []
    for hand in HANDS:
        grid = hand_grid(hand)
        values = value_map(model, carry, planned[None], hand, grid)[0].float().cpu().numpy()
        y = float(np.float32(target[HAND_AXES[hand][1]]))
        maps.append(ValueMap(hand, grid.x, y, grid.z, values))
    return tuple(maps)
