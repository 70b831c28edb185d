"""Episodes whose events, returns and outcomes are known, and another robot."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import draccus
import numpy as np

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, Episode, Provenance
from egovcp.robot_spec import RobotSpec
from egovcp_collect.config import CollectConfig

LENGTH = 80
SETTINGS = Provenance(
    "stance-1",
    seed=5,
    command="egovcp-collect --task=ball --note='a|b'",
    versions={"mujoco": "3.11.0"},
    config=draccus.encode(CollectConfig()),
    origin="simulated",
)


#: Another robot than the G1.
ARM = RobotSpec(
    robot_type="arm",
    depth=(32, 48),
    depth_max_m=1.5,
    planner_hz=20,
    state_names=("angle.a", "angle.b"),
    action_names=("a", "b"),
    action_box=spec.ActionBox((-1.0, -2.0), (0.0, 0.0), (1.0, 2.0)),
)


def make_episode(
    number: int,
    rewards: Mapping[int, float] = {},
    task: str = "ball",
    terms: Sequence[str] = (),
    length: int = LENGTH,
    time_limit: int = LENGTH,
    **facts: Any,
) -> Episode:
    """An upright robot that wanders at random; the reward is zero but where ``rewards`` says.

    Each of ``terms`` acts in one tick.
    """
    rng = np.random.default_rng(number)
    state = np.zeros((length, spec.STATE_DIM), np.float32)
    state[:, spec.STATE_SLICES["projected_gravity"]] = (0.0, 0.0, -1.0)
    state[:, spec.STATE_SLICES["command_height"]] = 0.7
    reward = np.zeros(length, np.float32)
    reward[list(rewards)] = list(rewards.values())
    last = np.arange(length) == length - 1
    depth = rng.integers(280, 4000, (length, spec.DEPTH_ROWS, spec.DEPTH_COLS), np.uint16)
    depth[:, ::2] = 0  # half of the pixels are not measured
    acted = {name: {"sum": 1.0, "ticks": 1} for name in terms}
    return Episode(
        depth=depth,
        state=state,
        action=rng.uniform(-1, 1, (length, spec.ACTION_DIM)).astype(np.float32),
        reward=reward,
        done=last,
        success=np.full(length, "block" in terms),
        truncated=last & (length == time_limit),
        task=task,
        time_limit=time_limit,
        metadata={"seed": 5, "episode": number, "event_tick": 20, "reward_terms": acted, **facts},
    )


def write_episodes(root: Path, episodes: Sequence[Episode]) -> DatasetReader:
    """A dataset of these episodes."""
    with DatasetWriter(root, SETTINGS) as writer:
        for episode in episodes:
            writer.add(episode)
    return DatasetReader.open(DatasetConfig(root=str(root)))


def three_balls() -> list[Episode]:
    """One blocked, one that hits and fells the robot, one that misses."""
    return [
        make_episode(
            0, {60: 1.0}, terms=("block",), contact_ticks={"hands": 3}, scene={"radius": 0.1}
        ),
        make_episode(1, {40: -1.0}, terms=("hit", "fall"), length=41, scene={"radius": 0.12}),
        make_episode(2, scene={"radius": 0.11}),
    ]
