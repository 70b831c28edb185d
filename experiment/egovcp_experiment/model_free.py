"""The model-free baseline as cells: one training of PPO, and the policies along it played.

ppo-TASK-sSEED
play-TASK-ppo_TRANSITIONS-sSEED
"""

from __future__ import annotations

from collections.abc import Mapping

from egovcp_experiment.cell import Cell, Output
from egovcp_experiment.grid import Grid
from egovcp_experiment.outcomes import Outcome, outcome
from egovcp_experiment.store import Record
from egovcp_experiment.tools import PLAY, PPO_POLICY, TRAIN_PPO


def plays(grid: Grid, task: str) -> dict[int, list[str]]:
    """Transitions -> names of the cells that play after so many, one for each seed."""
    config = grid.config.ppo
    found: dict[int, list[str]] = {}
    for seed in grid.config.train.seeds:
        for k, seen in enumerate(config.transitions):
            checkpoint = f"{config.updates * (k + 1):06d}"
            path = f"checkpoints/{checkpoint}/{PPO_POLICY}"
            policy = Output(_training(grid, task, seed).name, path)
            flags = {**grid.scenarios(task), "controllers": "ppo", "ppo.path": policy}
            cell = grid.add(Cell(f"play-{task}-ppo_{seen}-s{seed}", PLAY, flags))
            found.setdefault(seen, []).append(cell.name)
    return found


def curve(grid: Grid, task: str, records: Mapping[str, Record]) -> dict[int, Outcome]:
    """Transitions -> how PPO plays after so many, of those results that are there."""
    cells = plays(grid, task)
    found = {seen: outcome(records, names, task, "ppo") for seen, names in cells.items()}
    return {seen: played for seen, played in found.items() if played is not None}


def _training(grid: Grid, task: str, seed: int) -> Cell:
    config = grid.config.ppo
    flags = {
        "task": task,
        "steps": config.transitions[-1],
        "robots": config.robots,
        "ppo.num_steps_per_env": config.ticks,
        "save_freq": config.updates,
        "seed": seed,
    }
    extra = (*grid.config.scenes, *config.flags)
    return grid.add(Cell(f"ppo-{task}-s{seed}", TRAIN_PPO, flags, extra))
