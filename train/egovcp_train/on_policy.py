"""Training with rsl-rl's PPO: options, learner, and the loop of iterations."""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, nullcontext, redirect_stdout
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from egovcp.bounds import bounded
from egovcp.cli import save_config
from egovcp.errors import DataError, UsageError
from egovcp.terminal import echo
from egovcp.workers import stop_on_signal
from egovcp_train.checkpoint import CONFIG_FILE, checkpoint_dir, new_checkpoint, restoring
from egovcp_train.loggers import TensorBoardLogger
from egovcp_train.loop import Budget

type Log = dict[str, list[float]]


@dataclass(frozen=True)
class RslRlPpoConfig:
    """Proximal policy optimisation; the names are rsl-rl's."""

    num_steps_per_env: int = bounded(24, least=1, most=100_000)
    """Ticks per robot and iteration."""
    num_learning_epochs: int = bounded(4, least=1, most=10_000)
    """Passes over the data of an iteration."""
    num_mini_batches: int = bounded(4, least=1, most=65_536)
    """Mini-batches per pass."""
    learning_rate: float = bounded(1e-3, above=0)
    """Initial learning rate; it then follows desired_kl."""
    desired_kl: float = bounded(0.02, above=0)
    """KL divergence per update at which the learning rate aims."""
    gamma: float = bounded(0.99, least=0, most=1)
    """Discount per tick."""
    lam: float = bounded(0.95, least=0, most=1)
    """Lambda of generalised advantage estimation."""
    clip_param: float = bounded(0.2, above=0)
    """Clipping of the probability ratio."""
    entropy_coef: float = bounded(0.0, least=0)
    """Weight of the entropy bonus."""


def require_mini_batches(robots: int, ppo: RslRlPpoConfig) -> None:
    """Raise `UsageError` if a mini-batch would be empty, or the advantages would have no standard
    deviation."""
    found, expected = robots * ppo.num_steps_per_env, max(2, ppo.num_mini_batches)
    if found < expected:
        raise UsageError(
            f"--robots={robots} times --ppo.num_steps_per_env={ppo.num_steps_per_env} are {found} "
            f"ticks per iteration; expected at least {expected}, at least one for each of "
            f"--ppo.num_mini_batches={ppo.num_mini_batches}"
        )


def rsl_rl_config(
    ppo: RslRlPpoConfig,
    actor: Mapping[str, Any],
    critic: Mapping[str, Any],
    obs_groups: Mapping[str, list[str]],
    initial_std: float,
    symmetry: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """rsl-rl's configuration.

    Args:
        actor: options of its model.
        critic: likewise.
        obs_groups: model -> groups of observations that it reads.
        symmetry: rsl-rl's ``symmetry_cfg``.
    """
    noise = {"class_name": "GaussianDistribution", "init_std": initial_std, "std_type": "log"}
    options = asdict(ppo)
    return {
        "num_steps_per_env": options.pop("num_steps_per_env"),
        "obs_groups": dict(obs_groups),
        "actor": {**actor, "distribution_cfg": noise},
        "critic": dict(critic),
        "algorithm": {
            **options,
            "class_name": "PPO",
            "schedule": "adaptive",
            "symmetry_cfg": symmetry,
            "rnd_cfg": None,
        },
        "multi_gpu": None,
    }


def shrink_output(mlp: torch.nn.Sequential) -> None:
    """Scale the last layer down, so that the initial actions are almost zero.

    Under symmetry augmentation, the probability ratios of mirrored samples are far from 1 for a
    policy that is not symmetric; one whose actions are near zero almost is.
    """
    last = [m for m in mlp if isinstance(m, torch.nn.Linear)][-1]
    with torch.no_grad():
        last.weight.mul_(0.01)
        last.bias.zero_()


class OnPolicyLearner(ABC):
    """An environment (rsl-rl's `VecEnv`) and PPO, one iteration at a time."""

    def __init__(self, env: Any, config: dict[str, Any]) -> None:
        from rsl_rl.algorithms import PPO  # an optional package

        self.env, self.iteration = env, 0
        self.ticks: int = config["num_steps_per_env"]
        with redirect_stdout(io.StringIO()):  # rsl-rl prints its networks
            self.ppo = PPO.construct_algorithm(env.get_observations(), env, config, "cpu")
        shrink_output(self.ppo.get_policy().mlp)
        self.ppo.train_mode()

    @property
    def steps(self) -> int:
        """Ticks simulated so far, over all robots."""
        return self.iteration * self.ticks * int(self.env.num_envs)

    def iterate(self) -> dict[str, float]:
        """Collect and update once; returns scalars to log."""
        log: Log = defaultdict(list)
        with torch.inference_mode():
            obs = self.env.get_observations()
            for _ in range(self.ticks):
                before = obs
                obs, reward, done, extras = self.env.step(self.ppo.act(obs))
                self.ppo.process_env_step(obs, reward, done, extras)
                self.record(log, before, reward, done, extras)
            self.ppo.compute_returns(obs)
        losses = self.update()
        self.iteration += 1
        losses |= {
            "learning_rate": self.ppo.learning_rate,
            "action_std": self.ppo.get_policy().output_std.mean().item(),
        }
        scalars = {name: float(np.mean(values)) for name, values in log.items()}
        return scalars | {f"ppo/{name}": float(value) for name, value in losses.items()}

    @abstractmethod
    def record(
        self, log: Log, obs: Any, reward: torch.Tensor, done: torch.Tensor, extras: dict[str, Any]
    ) -> None:
        """Add the values of a tick to the log; their mean is recorded per iteration."""

    def update(self) -> dict[str, float]:
        """One update of PPO; returns its losses."""
        losses: dict[str, float] = self.ppo.update()
        return losses

    def state_dict(self) -> dict[str, Any]:
        """Networks and optimiser; after a resume the robots start new episodes."""
        return {"ppo": self.ppo.save(), "iteration": self.iteration}

    @property
    def is_finite(self) -> bool:
        """Whether all weights are finite."""
        groups = self.ppo.optimizer.param_groups
        return all(bool(x.isfinite().all()) for group in groups for x in group["params"])

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` has returned."""
        self.ppo.load(state["ppo"], None, strict=True)
        self.iteration = int(state["iteration"])


def run_iterations(
    learner: OnPolicyLearner,
    config: Any,
    output: Path,
    state: dict[str, Any],
    write_policy: Callable[[Path], None],
    summary: Callable[[dict[str, float]], dict[str, str]],
    final_message: Callable[[Path, str], str],
) -> None:
    """Train until the budget or a signal ends the run; the last state is always saved.

    Args:
        config: options of the command, which are stored.
        state: training state from which the run is resumed; empty without ``config.resume``.
        write_policy: writes the policy to a folder.
        summary: scalars of an iteration -> text beside the progress bar.
        final_message: folder of the last policy and "done" or "stopped early" -> text at the end.

    Raises:
        ArtifactError: the training state does not fit the options.
        DataError: a weight is not finite.
        KeyboardInterrupt: a signal ended the run early.
    """
    if config.resume:
        with restoring(output):
            learner.load_state_dict(state)
    output.mkdir(parents=True, exist_ok=True)
    save_config(replace(config, resume=False), str(output / CONFIG_FILE))
    budget = Budget(config.steps, config.max_minutes, spent=float(state.get("seconds", 0.0)))

    def save() -> None:
        state = learner.state_dict() | {"seconds": budget.spent}
        with new_checkpoint(output, learner.iteration, state) as folder:
            write_policy(folder)

    start = learner.iteration
    tensorboard = closing(TensorBoardLogger(output)) if config.tensorboard else nullcontext()
    with (
        tensorboard as logger,
        stop_on_signal() as stopped,
        tqdm(
            total=budget.steps,
            initial=learner.steps,
            unit="step",
            unit_scale=True,
            desc="ppo",
            mininterval=2.0,
        ) as bar,
    ):
        while budget.progress(learner.steps) < 1.0 and not stopped:
            with _divergence_reported(learner, output):
                scalars = learner.iterate()
            if logger:
                logger.log_scalars(learner.steps, scalars)
            bar.set_postfix(summary(scalars), refresh=False)
            bar.update(learner.steps - bar.n)
            if learner.iteration % config.save_freq == 0:
                save()
        final = checkpoint_dir(output, learner.iteration)
        has_learned = learner.iteration > start
        if (has_learned and learner.iteration % config.save_freq) or not final.exists():
            save()
    finished = budget.progress(learner.steps) >= 1.0
    outcome = "done" if finished else "stopped early"
    echo(final_message(final / "pretrained_model", outcome))
    if not finished:
        raise KeyboardInterrupt


@contextmanager
def _divergence_reported(learner: OnPolicyLearner, output: Path) -> Iterator[None]:
    """Raise `DataError` if a weight is not finite at the end of the block, or after an error in
    it."""
    number, failure = learner.iteration + 1, None
    try:
        yield
    except (RuntimeError, ValueError) as error:  # of sampling from a normal distribution
        if learner.is_finite:
            raise
        failure = error
    if failure or not learner.is_finite:
        last = output / "checkpoints" / "last"
        kept = f"the last checkpoint is {last.resolve()}" if last.exists() else "none was saved"
        raise DataError(
            f"PPO diverged in iteration {number}: a weight is not finite; {kept}; train again with "
            "a lower --ppo.learning_rate"
        ) from failure
