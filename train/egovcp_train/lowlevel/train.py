"""``egovcp-train-lowlevel``: trains the controller that stands, squats, reaches and walks."""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import draccus
import torch

from egovcp.bounds import MAX_PER_CORE, bounded
from egovcp.cli import given_options, run_command
from egovcp.hardware import available_cores
from egovcp.packages import SIMULATOR_MODULES, require_packages
from egovcp.robot.controllers import load_walk_policy
from egovcp.robot.walk_policy import export_onnx
from egovcp.robot.walking import WalkConfig
from egovcp.sim.config import SensorConfig, require_memory_for_robots
from egovcp_train.checkpoint import load_training_state, prepare_output, resumed_options
from egovcp_train.lowlevel.config import CurriculumConfig, LowLevelTask, NetworkConfig
from egovcp_train.on_policy import RslRlPpoConfig, require_mini_batches, run_iterations

PROG = "egovcp-train-lowlevel"
POLICY_FILE = "walk.safetensors"
ONNX_FILE = "walk.onnx"


@dataclass(frozen=True)
class LowLevelTrainConfig:
    """Train the low-level controller with PPO (rsl-rl) in MuJoCo on the CPU.

    The result, OUTPUT_DIR/checkpoints/last/pretrained_model/walk.safetensors, is a controller
    for egovcp-eval-lowlevel and for the simulator; walk.onnx beside it is the same for a robot
    computer. Ctrl-C stops the run, --resume continues it.
    """

    output_dir: str
    """Folder of the run; must not exist unless --resume."""
    task: LowLevelTask = field(default_factory=LowLevelTask)
    """Commands, disturbances and rewards."""
    walk: WalkConfig = field(default_factory=WalkConfig)
    """Parts of the controller around the policy: stance law, gait, arms."""
    init: str = ""
    """Controller whose network and parameters (--walk) the policy starts from: walk (which the
    package ships) or PATH.safetensors; empty: a new network."""
    critic_warmup: int = bounded(0, least=0, most=100_000)
    """Iterations at the start that train the critic alone; for --init."""
    sensors: SensorConfig = field(default_factory=SensorConfig)
    """Noise of proprioception."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Policy and critic."""
    ppo: RslRlPpoConfig = field(default_factory=RslRlPpoConfig)
    """Proximal policy optimisation."""
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    """When the task becomes harder."""
    robots: int = bounded(512, least=1, most=65_536)
    """Robots simulated side by side."""
    feet: Literal["points", "stock"] = "points"
    """Foot collision model; four points are twice as fast."""
    steps: int = bounded(50_000_000, least=1)
    """Control steps of 20 ms, over all robots."""
    max_minutes: float = bounded(0.0, least=0)
    """Wall-clock limit in minutes, over all resumes; 0: none."""
    seed: int = bounded(0, least=0)
    """Seed of networks, commands, disturbances and noise."""
    threads: int = bounded(0, least=0, per_core=MAX_PER_CORE)
    """CPU threads; 0: all cores."""
    resume: bool = False
    """Continue the run in output_dir from its last checkpoint, with its options unless given."""
    save_freq: int = bounded(50, least=1)
    """Iterations between checkpoints; one is always written at the end."""
    tensorboard: bool = True
    """Write TensorBoard records to OUTPUT_DIR/tensorboard."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(
        LowLevelTrainConfig,
        train,
        argv,
        prog=PROG,
        defaults=_defaults,
    )


def _defaults(argv: Sequence[str]) -> dict[str, Any]:
    """The options of the run that is resumed, or the parameters of the controller of --init."""
    resumed = resumed_options(LowLevelTrainConfig, argv)
    init = given_options(argv).get("init")
    if resumed or not init:
        return resumed
    return {"walk": draccus.encode(load_walk_policy(init).config)}


def train(config: LowLevelTrainConfig) -> None:
    """Run PPO to its end, or to the first SIGINT or SIGTERM, and write the controller.

    Raises:
        UsageError: the network of --init has another size.
        ArtifactError: the file of --init cannot be used.
        KeyboardInterrupt: a signal ended it early; the checkpoint is written.
    """
    require_mini_batches(config.robots, config.ppo)
    require_memory_for_robots("--robots", config.robots)
    output = prepare_output(config.output_dir, config.resume)
    threads = config.threads or available_cores()
    torch.set_num_threads(threads)
    torch.manual_seed(config.seed)
    state = load_training_state(output) if config.resume else {}
    starts = not config.resume or int(state.get("iteration", 0)) < config.critic_warmup
    init = load_walk_policy(config.init) if config.init and starts else None
    learner = _build(config, threads)

    def final_message(folder: Path, outcome: str) -> str:
        final, difficulty = folder / POLICY_FILE, learner.env.logic.difficulty
        return (
            f"{PROG}: {outcome} after {learner.steps} steps, difficulty {difficulty:.2f}\n"
            f"controller: {final}\n"
            f"next: egovcp-eval-lowlevel --controller={shlex.quote(str(final))} --output_dir=..."
        )

    with contextlib.closing(learner.env):
        if init is not None:
            learner.start_from(init, resumed=config.resume)
        write_policy = partial(_write_policy, config, learner)
        run_iterations(learner, config, output, state, write_policy, _summary, final_message)


def _build(config: LowLevelTrainConfig, threads: int) -> Any:
    """The environment and PPO; imported here, so that --help needs neither."""
    # onnx, too: each checkpoint holds the controller as an ONNX graph
    require_packages("egovcp-train", PROG, "onnx", "rsl_rl", "tensordict", *SIMULATOR_MODULES)
    from egovcp_train.lowlevel.env import LowLevelEnv
    from egovcp_train.lowlevel.learner import LowLevelLearner

    env = LowLevelEnv(
        config.robots,
        config.task,
        config.walk,
        config.sensors,
        feet=config.feet,
        threads=threads,
        seed=config.seed,
    )
    env.spread_ends()
    return LowLevelLearner(env, config.network, config.ppo, config.curriculum, config.critic_warmup)


def _write_policy(config: LowLevelTrainConfig, learner: Any, folder: Path) -> None:
    from egovcp_train.lowlevel.learner import walk_policy

    provenance = {
        "command": [PROG, *sys.argv[1:]],
        "seed": config.seed,
        "steps": learner.steps,
        "difficulty": float(learner.env.logic.difficulty),
        "train_config": draccus.encode(config),
    }
    policy = walk_policy(learner.ppo.get_policy(), config.walk, provenance)
    policy.save(folder / POLICY_FILE)
    export_onnx(policy, folder / ONNX_FILE)


def _summary(scalars: dict[str, float]) -> dict[str, str]:
    return {
        "difficulty": f"{scalars['episode/difficulty']:.2f}",
        "falls/s": f"{scalars['falls_per_second']:.3f}",
        "v": f"{scalars['reward/velocity']:.2f}",
        "reward": f"{scalars['reward/total']:.2f}",
    }
