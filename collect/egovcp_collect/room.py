"""Is there room on the disk for what a collection is about to write?"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from egovcp import spec
from egovcp.data import tiff
from egovcp.errors import EnvironmentFailure
from egovcp.sim.config import EnvConfig
from egovcp.sim.scenario import Scenario

#: Bytes of a frame in a sealed episode, which is not compressed: its TIFF strip and the numbers.
SEALED_FRAME_BYTES: Final = (
    len(tiff.header(spec.DEPTH_ROWS, spec.DEPTH_COLS))
    + 2 * spec.DEPTH_ROWS * spec.DEPTH_COLS
    + 4 * (spec.STATE_DIM + spec.ACTION_DIM + 1)
)
#: As little of it as the compression of the data files has been seen to leave: of 6.6 kB, 1.8 kB
#: in ball episodes, 2.1 kB in arch and 3.8 kB in wall episodes of the default scenes.
LEAST_SHARE: Final = 0.2


def least_bytes(scenarios: Sequence[Scenario], env: EnvConfig, shard_episodes: int) -> int:
    """Bytes that the episodes will take at the least, one shard of them not yet compressed."""
    ticks = [env.episode(scenario.task).ticks for scenario in scenarios]
    waiting = sum(ticks[:shard_episodes])
    return round(SEALED_FRAME_BYTES * (LEAST_SHARE * sum(ticks) + (1 - LEAST_SHARE) * waiting))


def require_room(
    folder: Path, scenarios: Sequence[Scenario], env: EnvConfig, shard_episodes: int
) -> None:
    """Refuse a collection that cannot end well, before its first episode.

    Args:
        folder: where the dataset goes; it exists.
        scenarios: the episodes that are missing.
        env: says how long an episode is.
        shard_episodes: how many wait uncompressed until they become a data file.

    Raises:
        EnvironmentFailure: there is clearly less room than they need.
    """
    needed = least_bytes(scenarios, env, shard_episodes)
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise EnvironmentFailure(
            f"{len(scenarios)} episodes need at least {needed} bytes below {folder}, where "
            f"{free} bytes are free; make room, ask for fewer --episodes, or choose another "
            "--dataset.root"
        )
