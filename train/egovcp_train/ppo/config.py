"""The options of ``egovcp-train-ppo``."""

from __future__ import annotations

from dataclasses import dataclass, field

from egovcp.bounds import MAX_PER_CORE, bounded, check_bounds
from egovcp.errors import UsageError
from egovcp.reactive import ReactiveConfig
from egovcp.sim.config import EnvConfig
from egovcp.sim.scenario import HELD_OUT
from egovcp.sim.tasks.registry import DEFAULT_TASK, select_tasks
from egovcp.spec import GAMMA
from egovcp_train.on_policy import RslRlPpoConfig


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
    """Scenes, sensors, delays and randomisation; the defaults are those of egovcp-collect."""
    network: ReactiveConfig = field(default_factory=ReactiveConfig)
    """Policy and critic."""
    initial_std: float = bounded(0.4, above=0)
    """Standard deviation of the actions at the start, box units."""
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
        if self.seed >= HELD_OUT:
            raise UsageError(
                f"--seed={self.seed}: expected a number from 0 to {HELD_OUT - 1}; the scenarios "
                "beyond are for evaluation"
            )

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks to learn."""
        return select_tasks(self.task, training=True)
