"""``egovcp-train-ppo``: the model-free baseline."""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import draccus
import torch

from egovcp.bounds import MAX_PER_CORE, bounded, check_bounds
from egovcp.cli import run_command
from egovcp.hardware import available_cores
from egovcp.packages import SIMULATOR_MODULES, require_packages
from egovcp.reactive import ReactiveConfig
from egovcp.robot.controllers import absolute_controller, make_controller
from egovcp.sim.config import EnvConfig, require_memory_for_robots
from egovcp.sim.scenario import require_training_seed
from egovcp.sim.tasks.registry import DEFAULT_TASK, select_tasks
from egovcp.spec import GAMMA
from egovcp_train.checkpoint import load_training_state, prepare_output, resumed_options
from egovcp_train.on_policy import RslRlPpoConfig, require_mini_batches, run_iterations

PROG = "egovcp-train-ppo"
POLICY_FILE = "ppo.safetensors"


@dataclass(frozen=True)
class PpoTrainConfig:
    """Train a policy without a world model with PPO (rsl-rl), on depth and proprioception.

    The baseline of the paper's figure 5. The result,
    OUTPUT_DIR/checkpoints/last/pretrained_model/ppo.safetensors, is played by
    egovcp-eval --controllers=ppo --ppo.path=FILE. Ctrl-C stops the run, --resume continues it.
    """

    output_dir: str
    """Folder of the run; must not exist unless --resume."""
    task: str = DEFAULT_TASK
    """One of `egovcp-task list`, package.module:Class, several in turn as ball,wall, or all."""
    env: EnvConfig = field(default_factory=EnvConfig)
    """Scenes, sensors, delays and randomisation. By default, episodes of ball and wall are longer
    than those of egovcp-collect."""
    network: ReactiveConfig = field(default_factory=ReactiveConfig)
    """Policy and critic."""
    initial_std: float = bounded(0.4, above=0)
    """Standard deviation of the actions at the start, normalised action units ([-1, 1])."""
    ppo: RslRlPpoConfig = field(
        default_factory=lambda: RslRlPpoConfig(
            num_steps_per_env=50, desired_kl=0.01, gamma=GAMMA, entropy_coef=0.002
        )
    )
    """Proximal policy optimisation."""
    robots: int = bounded(32, least=1, most=65_536)
    """Robots simulated side by side."""
    steps: int = bounded(1_000_000, least=1)
    """Planner ticks of 40 ms, over all robots: transitions."""
    max_minutes: float = bounded(0.0, least=0)
    """Wall-clock limit in minutes, over all resumes; 0: none."""
    seed: int = bounded(0, least=0)
    """Seed of scenarios, networks and actions."""
    threads: int = bounded(0, least=0, per_core=MAX_PER_CORE)
    """CPU threads of the networks; 0: all cores. Those of the simulator are --env.threads."""
    resume: bool = False
    """Continue the run in output_dir from its last checkpoint, with its options unless given."""
    save_freq: int = bounded(20, least=1)
    """Iterations between checkpoints; one is always written at the end."""
    tensorboard: bool = True
    """Write TensorBoard records to OUTPUT_DIR/tensorboard."""

    def __post_init__(self) -> None:
        check_bounds(self)
        select_tasks(self.task, training=True)
        require_training_seed(self.seed)

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks to learn."""
        return select_tasks(self.task, training=True)


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
    require_mini_batches(config.robots, config.ppo)
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
            f"next: egovcp-eval --controllers=ppo --ppo.path={shlex.quote(str(final))} --task=... "
            "--output_dir=..."
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
