"""``egovcp-train``: trains a world model from a dataset and writes a policy."""

from __future__ import annotations

import dataclasses
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any, Final

import draccus
import torch
from torch import Tensor
from tqdm import tqdm

from egovcp.artifact import require_same_returns, save_artifact
from egovcp.cli import preset_defaults, run_command, save_config
from egovcp.data import EpisodeIndex, describe_heldout
from egovcp.entry_point import raise_interrupt
from egovcp.errors import UsageError
from egovcp.files import removed_on_error
from egovcp.manifest import finite_or_null
from egovcp.model import WorldModel
from egovcp.model.weights import tensor_shapes
from egovcp.packages import SIMULATOR_MODULES, require_packages
from egovcp.plan.backends import make_evaluator
from egovcp.terminal import echo, one_line
from egovcp.workers import stop_on_signal
from egovcp_train import privileged_value
from egovcp_train.checkpoint import (
    CONFIG_FILE,
    checkpoint_dir,
    load_training_state,
    new_checkpoint,
    prepare_output,
    pretrained_weights,
    restoring,
    resumed_options,
)
from egovcp_train.closed_loop import ClosedLoop
from egovcp_train.config import PRESETS, TrainConfig
from egovcp_train.datasets import (
    EVALUATION_EPISODES,
    TrainingData,
    check_options,
    convert_if_needed,
    open_readers,
    prepare,
    require_batch_memory,
    require_datasets,
    require_same_content,
    to_tensors,
)
from egovcp_train.device import (
    choose_bf16,
    choose_device,
    keep_freed_memory,
    reporting_full_memory,
)
from egovcp_train.heldout.pictures import draw, record, table
from egovcp_train.heldout.report import HeldoutReport, episode_batches, measure, scalars
from egovcp_train.loggers import make_loggers
from egovcp_train.loop import Budget, Learner
from egovcp_train.publish import publish_trained, reserve_policy, training_versions, write_card

PROG = "egovcp-train"
EPILOG = (
    "Other options are set by --preset, or by a file instead: copy train_config.yaml of a run, "
    "edit it, and give --config_path."
)
_FIT_SHARE: Final = 0.25  # part of --max_minutes that the fit of the critic takes at most
_NOT_CAPTURED = (
    f"{PROG}: the training step could not be captured as a CUDA graph ({{reason}}), so it runs "
    "many times slower; results are correct; --device=cpu may be as fast; please report this"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(TrainConfig, train, argv, prog=PROG, epilog=EPILOG, defaults=option_defaults)


def option_defaults(argv: Sequence[str]) -> dict[str, Any]:
    """The defaults of the options: those of the run that is resumed, or of --preset.

    Raises:
        UsageError: --preset and --config_path are both given.
    """
    if options := resumed_options(TrainConfig, argv):
        return options
    defaults = preset_defaults(PRESETS, argv)
    defaults.pop("output_dir", None)
    return defaults


def train(config: TrainConfig) -> None:
    """Run training to its end, or to the first SIGINT or SIGTERM, and write the artifact.

    Raises:
        KeyboardInterrupt: a signal ended it early; after the first step, the checkpoint is written.
        UsageError: an option is invalid, or a launcher has started several processes.
        DataError: a dataset is damaged or has changed, or the loss or a weight is not finite.
        ArtifactError: the policy to start from, or the checkpoint to resume, cannot be read.
        EnvironmentFailure: too little memory, or Hub, W&B or the planner's backend cannot be used.
    """
    _require_one_process()
    device = choose_device(config.device)
    bf16 = choose_bf16(config.mixed_precision, device)
    output = _prepare_output(config)
    reserve_policy(config.policy)
    keep_freed_memory()
    torch.set_num_threads(config.threads or torch.get_num_threads())
    torch.manual_seed(config.seed)
    with reporting_full_memory(), ExitStack() as stack:
        previous = signal.signal(signal.SIGTERM, raise_interrupt)
        stack.callback(signal.signal, signal.SIGTERM, previous)
        is_converted = bool(config.features)
        config = convert_if_needed(config)
        with removed_on_error(Path(config.dataset.root)) if is_converted else nullcontext():
            run = _prepare_run(config, output, device, bf16)
        run.execute()


def _prepare_run(
    config: TrainConfig, output: Path, device: torch.device, bf16: bool
) -> TrainingRun:
    """Load the data, build or restore the learner, and write the options of the run."""
    readers = open_readers(config)
    robot = readers[0].robot
    require_batch_memory(config, device, robot)
    model = WorldModel(config.policy.world_model(robot), robot)
    initial: dict[str, Tensor] = {}
    if config.policy.pretrained_path and not config.resume:
        initial = pretrained_weights(model, config.policy.pretrained_path, config.returns)
    data = prepare(config, readers, model)
    config = data.config
    if initial:
        model.load_state_dict(initial)
    learner = Learner(model.to(device), config.optimizer, config.seed, bf16, config.planner)
    provenance = _provenance(data)
    closed_loop = None
    if config.eval_closed_loop:
        make_evaluator(model, config.planner)  # refuses a backend that cannot be used here
        tasks, controller = provenance["tasks"], provenance["controller_id"]
        closed_loop = ClosedLoop(tasks, config.eval_closed_loop, config.seed, controller)
    if config.resume:
        spent_s, fit_s = _restore(output, learner, data)
    else:
        fit_budget = Budget(config.critic_fit.updates, _FIT_SHARE * config.max_minutes)
        learner.critic = privileged_value.prepare(learner.model, data, fit_budget.progress, bf16)
        spent_s = fit_s = fit_budget.spent
    budget = Budget(config.steps, config.max_minutes, spent=spent_s, fit_seconds=fit_s)
    output.mkdir(parents=True, exist_ok=True)
    save_config(dataclasses.replace(config, resume=False), str(output / CONFIG_FILE))
    return TrainingRun(config, output, learner, data, device, provenance, budget, closed_loop)


def _require_one_process() -> None:
    """Raise `UsageError` under a launcher of several processes, each of which would train alone."""
    count = os.environ.get("WORLD_SIZE", "1")
    if count != "1":
        raise UsageError(
            f"WORLD_SIZE={count} in the environment: expected one process (1, or unset); start "
            f"{PROG} itself, without torchrun or accelerate launch"
        )


class TrainingRun:
    """One training run: steps, evaluations, checkpoints."""

    def __init__(
        self,
        config: TrainConfig,
        output: Path,
        learner: Learner,
        data: TrainingData,
        device: torch.device,
        provenance: dict[str, Any],
        budget: Budget,
        closed_loop: ClosedLoop | None = None,
    ) -> None:
        self.config, self.output, self.learner, self.data = config, output, learner, data
        self.device, self.provenance, self.closed_loop = device, provenance, closed_loop
        self.budget = budget
        self.metrics: dict[str, float] = {}
        self.tasks: dict[str, dict[str, Any]] = {}
        self.closed_loop_metrics: dict[str, float] = {}
        self.evaluated_step = -1
        self.loggers = make_loggers(config, output)

    def execute(self) -> None:
        """Train until the budget is spent or a signal comes, then evaluate and save. After an error
        the last periodic checkpoint remains.

        Raises:
            KeyboardInterrupt: a signal has ended it.
        """
        learner = self.learner
        start = learner.step
        with ExitStack() as stack:
            for logger in self.loggers:
                stack.callback(logger.close)
            with stop_on_signal() as stopped:
                finished = self._learn(stopped)
                final = checkpoint_dir(self.output, learner.step)
                if learner.step > start or not final.exists():
                    self.finish()
            self._conclude(final, finished)
        if not finished:
            raise KeyboardInterrupt

    def _conclude(self, final: Path, finished: bool) -> None:
        """Print the result, write the card, and publish a finished policy."""
        artifact = final / "pretrained_model"
        echo(self._final_message(artifact, stopped=not finished))
        write_card(artifact, self.output, self.config.policy.repo_id)
        if finished:
            for logger in self.loggers:
                logger.log_policy(self.learner.step, artifact)
        if finished and self.config.policy.push_to_hub:
            publish_trained(artifact, self.config.policy)

    def _learn(self, stopped: list[int]) -> bool:
        """Step until the budget is spent or a signal comes; returns whether it is spent."""
        config, learner, start = self.config, self.learner, self.learner.step
        ticks = config.sampling.length + config.sampling.burn_in
        frames = config.batch_size * ticks
        warned = False
        with tqdm(
            total=config.steps, initial=start, unit="step", desc="train", mininterval=1.0
        ) as bar:
            while True:
                progress = self.budget.progress(learner.step)
                if progress >= 1.0 or stopped:
                    return progress >= 1.0
                if learner.step > start:
                    self._evaluate_and_save_if_due()
                batch = to_tensors(next(self.data.stream), self.device)
                terms = learner.update(batch, progress)
                bar.update()
                if learner.step % config.log_freq == 0:
                    self._log({k: float(v) for k, v in terms.items()})
                    bar.set_postfix(self._summary(terms, bar, frames))
                    if learner.capture_error and not warned:
                        warned = True
                        bar.write(one_line(_NOT_CAPTURED.format(reason=learner.capture_error)))

    def _evaluate_and_save_if_due(self) -> None:
        """Evaluate, save and log what is due between two steps."""
        config, learner, report = self.config, self.learner, None
        if config.eval_freq and learner.step % config.eval_freq == 0:
            report = self.measure()
        if learner.step % config.save_freq == 0:
            self.save()
        if report is not None:
            self.show(report)

    def finish(self) -> None:
        """Measure and save the model, and record the measurements."""
        report = self.measure()
        self.save()
        self.show(report)  # after saving: drawing may fail
        record(report, self.output, self.learner.averaged.config.depth_max_m)

    def measure(self) -> HeldoutReport:
        """Measure the averaged model on held-out episodes, and in simulation if configured."""
        episodes = episode_batches(self.data.heldout, self.device, EVALUATION_EPISODES)
        model, critic = self.learner.averaged, self.learner.critic
        report = measure(model, episodes, critic=critic.value if critic else None)
        self.metrics, self.tasks = report.metrics, report.tasks
        if self.closed_loop is not None:
            self.closed_loop_metrics = self.closed_loop.play(model, self.config.planner)
        self.evaluated_step = self.learner.step
        return report

    def show(self, report: HeldoutReport) -> None:
        """Record the last measurements and their pictures."""
        heldout = self.metrics | scalars(self.tasks)
        metrics = {f"heldout/{k}": v for k, v in heldout.items()}
        self._log(metrics | {f"closed_loop/{k}": v for k, v in self.closed_loop_metrics.items()})
        pictures = draw(report) if self.loggers else {}
        for logger in self.loggers:
            for name, picture in pictures.items():
                logger.log_image(self.learner.step, f"heldout/{name}", picture)

    def _log(self, values: dict[str, float]) -> None:
        for logger in self.loggers:
            logger.log_scalars(self.learner.step, values)

    def save(self) -> None:
        """Write a checkpoint: the averaged model as artifact, and the training state.

        Raises:
            DataError: the model is not finite.
        """
        self.learner.require_finite()
        names = ("heldout", "heldout_tasks", "closed_loop")
        measured = (self.metrics, self.tasks, self.closed_loop_metrics)
        is_current = self.evaluated_step == self.learner.step
        metrics = {k: v if is_current else {} for k, v in zip(names, measured, strict=True)}
        provenance = self.provenance | {"step": self.learner.step, **finite_or_null(metrics)}
        state = {
            "learner": self.learner.state_dict(),
            "stream": self.data.stream.state_dict(),
            "datasets": [reader.content_digest for reader in self.data.readers],
            "seconds": self.budget.spent,
            "fit_seconds": self.budget.fit_seconds,
        }
        with new_checkpoint(self.output, self.learner.step, state) as folder:
            shipped = self.learner.averaged.without_object_head()
            save_artifact(folder, shipped, self.config.planner, provenance)

    def _summary(self, terms: dict[str, Any], bar: Any, frames: int) -> dict[str, str]:
        summary = {"loss": f"{float(terms['loss/total']):.3f}"}
        if bar.format_dict["rate"]:
            summary["frames/s"] = f"{bar.format_dict['rate'] * frames:.0f}"
        if "value/r2" in self.metrics:
            summary["heldout_r2"] = f"{self.metrics['value/r2']:.3f}"
        return summary

    def _final_message(self, artifact: Path, stopped: bool) -> str:
        state = "stopped early" if stopped else "done"
        lines = [f"{PROG}: {state} at step {self.learner.step}"]
        for title, metrics in (
            ("held-out episodes:", self.metrics),
            ("simulation:", self.closed_loop_metrics),
        ):
            if metrics:
                values = [f"  {name:<20} {value:.4f}" for name, value in sorted(metrics.items())]
                lines += [title, *values]
        if self.tasks:
            lines.append(table(self.tasks))
        next_step = f"next: egovcp-eval --policy.path={artifact} --task=... --output_dir=..."
        if stopped:
            next_step = f"continue: {PROG} --output_dir={self.output} --resume"
        return "\n".join([*lines, f"artifact: {artifact}", next_step])


def _prepare_output(config: TrainConfig) -> Path:
    """Check packages, sizes and folders before any work starts; returns the output folder."""
    for flag, wanted in (("wandb.enable", config.wandb.enable), ("trackio", config.trackio)):
        if wanted:
            require_packages("egovcp-train", f"--{flag}", flag.partition(".")[0])
    check_options(config)
    try:
        tensor_shapes(config.policy.world_model())
    except ValueError as error:
        raise UsageError(f"--policy: {error}; make the networks smaller") from error
    if config.eval_closed_loop:
        require_packages("egovcp-train", "--eval_closed_loop", *SIMULATOR_MODULES)
    output = prepare_output(config.output_dir, config.resume)
    if config.resume:
        require_datasets(config)
    return output


def _restore(output: Path, learner: Learner, data: TrainingData) -> tuple[float, float]:
    """Restore the last checkpoint; returns the seconds that the run has taken so far, and those of
    them before its first step.

    Raises:
        ArtifactError: the networks have changed.
        DataError: the dataset has changed.
        UsageError: the windows, or discount or scale of the returns, have changed.
    """
    state = load_training_state(output)
    with restoring(output):
        require_same_content(data.readers, state["datasets"])
        learner.load_state_dict(state["learner"])
        require_same_returns(
            learner.model.state_dict(), data.config.returns, f"the run in {output}"
        )
        data.stream.load_state_dict(state["stream"])
        return float(state["seconds"]), float(state.get("fit_seconds", 0.0))


def _provenance(data: TrainingData) -> dict[str, Any]:
    readers = data.readers
    return {
        "controller_id": readers[0].controller_id,
        "tasks": sorted(set(EpisodeIndex.of(readers).tasks)),
        "versions": training_versions(),
        "datasets": [
            {"repo_id": r.source.repo_id, "revision": r.source.commit, "episodes": r.episodes}
            for r in readers
        ],
        "heldout_episodes": describe_heldout(readers),
        "train_config": draccus.encode(data.config),
        "command": [PROG, *sys.argv[1:]],
    }


if __name__ == "__main__":
    sys.exit(main())
