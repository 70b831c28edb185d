"""``egovcp-train-ppo``: the model-free baseline."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import draccus
import torch

from egovcp.cli import run_command
from egovcp.hardware import available_cores
from egovcp.packages import SIMULATOR_MODULES, require_packages
from egovcp.robot.controllers import absolute_controller, make_controller
from egovcp.sim.config import require_memory_for_robots
from egovcp_train.checkpoint import load_training_state, prepare_output, resumed_options
from egovcp_train.on_policy import run_iterations
from egovcp_train.ppo.config import PpoTrainConfig

PROG = "egovcp-train-ppo"
POLICY_FILE = "ppo.safetensors"


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(
        PpoTrainConfig, train, argv, prog=PROG, defaults=partial(resumed_options, PpoTrainConfig)
    )


def train(config: PpoTrainConfig) -> None:
    """Run PPO to its end, or to the first SIGINT or SIGTERM, and write the policy.

    Raises:
        KeyboardInterrupt: a signal ended it early; the checkpoint is written.
    """
    require_memory_for_robots("--robots", config.robots)
    output = prepare_output(config.output_dir, config.resume)
    make_controller(config.env.controller)  # raises before the simulator is imported
    controller = absolute_controller(config.env.controller)  # resumed from any working directory
    config = dataclasses.replace(config, env=dataclasses.replace(config.env, controller=controller))
    torch.set_num_threads(config.threads or available_cores())
    torch.manual_seed(config.seed)
    state = load_training_state(output) if config.resume else {}
    learner = _build(config, int(state.get("episodes", 0)))

    def write_policy(folder: Path) -> None:
        learner.policy(_provenance(config, learner)).save(folder / POLICY_FILE)

    def final_message(folder: Path, outcome: str) -> str:
        final = folder / POLICY_FILE
        return (
            f"{PROG}: {outcome} after {learner.steps} steps\n"
            f"policy: {final}\n"
            f"next: egovcp-eval --controllers=ppo --ppo.path={final} --task=... --output_dir=..."
        )

    with contextlib.closing(learner.env):
        run_iterations(learner, config, output, state, write_policy, _summary, final_message)


def _build(config: PpoTrainConfig, first_episode: int) -> Any:
    """The simulator and PPO; imported here, so that --help needs neither."""
    require_packages("egovcp-train", PROG, "rsl_rl", "tensordict", *SIMULATOR_MODULES)
    from egovcp_train.ppo.learner import ContactLearner

    return ContactLearner(config, first_episode)


def _provenance(config: PpoTrainConfig, learner: Any) -> dict[str, Any]:
    return {
        "command": [PROG, *sys.argv[1:]],
        "seed": config.seed,
        "tasks": list(config.tasks),
        "steps": learner.steps,
        "episodes": learner.env.episodes,
        "train_config": draccus.encode(config),
    }


def _summary(scalars: dict[str, float]) -> dict[str, str]:
    ended = {k: f"{v:.2f}" for k, v in scalars.items() if k.endswith(("/return", "/success"))}
    return {"reward": f"{scalars['reward']:.4f}", **ended}
