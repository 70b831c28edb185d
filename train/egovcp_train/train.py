"""``egovcp-train``: dataset in, policy artefact out."""

from __future__ import annotations

import copy
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import draccus
import torch
from tqdm import tqdm

from egovcp.artefact import save_artefact
from egovcp.cli import run_command, save_config
from egovcp.data import EpisodeIndex, describe_heldout
from egovcp.data.ahead import Ahead
from egovcp.errors import ArtefactError, UsageError
from egovcp.model import PRESETS, WorldModel
from egovcp_train.batches import to_tensors
from egovcp_train.card import versions, write_card
from egovcp_train.checkpoint import (
    begin_checkpoint,
    checkpoint_dir,
    finish_checkpoint,
    load_training_state,
)
from egovcp_train.config import TRAINING_PRESETS, TrainConfig
from egovcp_train.datasets import EVALUATION_EPISODES, Material, prepare
from egovcp_train.device import choose_device
from egovcp_train.heldout.episodes import recorded
from egovcp_train.heldout.pictures import draw
from egovcp_train.heldout.report import measure, scalars
from egovcp_train.heldout.table import table
from egovcp_train.loop import Budget, Learner
from egovcp_train.output import CONFIG_FILE, prepare_output, resumed_options, stop_on_signal
from egovcp_train.publish import publish_trained, reserve_policy
from egovcp_train.records import Recorder
from egovcp_train.value_fit import fit_value

PROG = "egovcp-train"


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(TrainConfig, train, argv, prog=PROG, defaults=option_defaults)


def option_defaults(argv: Sequence[str]) -> dict[str, Any]:
    """What stands where no flag says otherwise: the options of the run that is resumed, or those
    that --preset stands for.

    Raises:
        UsageError: a config file, which says everything itself, would hide the preset.
    """
    if options := resumed_options(argv):
        return options
    given = dict(a.removeprefix("--").split("=", 1) for a in argv if "=" in a)
    if "preset" in given and "config_path" in given:
        raise UsageError(
            f"--preset={given['preset']} and --config_path={given['config_path']} both say what "
            "the other options are; give one of them, and single options as flags of their own"
        )
    name = given.get("preset", "")
    policy = {"policy": draccus.encode(PRESETS[name])} if name in PRESETS else {}
    return policy | TRAINING_PRESETS.get(name, {})


def train(config: TrainConfig) -> None:
    """Run training to its end, or to the first SIGINT or SIGTERM, and write the artefact."""
    output = _prepare_output(config)
    torch.set_num_threads(config.threads or torch.get_num_threads())
    device = choose_device(config.device)
    torch.manual_seed(config.seed)
    model = WorldModel(config.policy.world_model())
    material = prepare(config, model)
    config = material.config
    learner = Learner(model.to(device), config.optimizer, config.seed)
    if config.resume:
        _restore(output, learner, material.stream)
    reserve_policy(config.policy)
    output.mkdir(parents=True, exist_ok=True)
    save_config(dataclasses.replace(config, resume=False), str(output / CONFIG_FILE))
    Run(config, output, learner, material, device, _provenance(material)).execute()


class Run:
    """One training run: steps, evaluations, checkpoints."""

    def __init__(
        self,
        config: TrainConfig,
        output: Path,
        learner: Learner,
        material: Material,
        device: torch.device,
        provenance: dict[str, Any],
    ) -> None:
        self.config, self.output, self.learner, self.material = config, output, learner, material
        self.device, self.provenance = device, provenance
        self.metrics: dict[str, float] = {}
        self.tasks: dict[str, dict[str, Any]] = {}
        self.recorder = Recorder(output, enabled=config.tensorboard)

    def execute(self) -> None:
        """Train until the budget or a signal ends it; the last state is always saved."""
        learner = self.learner
        budget = Budget(self.config.steps, self.config.max_minutes)
        start = learner.step
        with stop_on_signal() as stopped:
            self._learn(budget, stopped)
            finished = budget.progress(learner.step) >= 1.0
            final = checkpoint_dir(self.output, learner.step)
            if learner.step > start or not final.exists():
                self.finish(fit=finished)
        self.recorder.close()
        print(self._last_words(final, stopped=not finished))
        write_card(final / "pretrained_model", self.output, self.config.policy.repo_id)
        if finished and self.config.policy.push_to_hub:
            publish_trained(final / "pretrained_model", self.config.policy)

    def _learn(self, budget: Budget, stopped: list[int]) -> None:
        """Step until the budget is spent or ``stopped`` fills."""
        config, learner, start = self.config, self.learner, self.learner.step
        frames = config.batch_size * (config.sampling.length + config.sampling.burn_in)
        with tqdm(
            total=config.steps, initial=start, unit="step", desc="train", mininterval=1.0
        ) as bar:
            while budget.progress(learner.step) < 1.0 and not stopped:
                if learner.step > start and learner.step % config.save_freq == 0:
                    self.save(learner.averaged)
                batch = to_tensors(next(self.material.stream), self.device)
                terms = learner.update(batch, budget.progress(learner.step))
                bar.update()
                if learner.step % config.log_freq == 0:
                    self.recorder.scalars(learner.step, {k: float(v) for k, v in terms.items()})
                    bar.set_postfix(self._summary(terms, bar, frames))
                if config.eval_freq and learner.step % config.eval_freq == 0:
                    self.evaluate(learner.averaged)

    def finish(self, fit: bool) -> None:
        """Fit Q on the states of the finished model, evaluate, and save what is shipped."""
        shipped = copy.deepcopy(self.learner.averaged)
        if fit:
            episodes = self.material.training_episodes(self.device)
            fit_value(shipped, episodes, self.config.value_fit, self.config.seed)
        self.evaluate(shipped)
        self.save(shipped)

    def evaluate(self, model: WorldModel) -> None:
        """Measure a model on held-out episodes."""
        config, step = self.config, self.learner.step
        heldout = self.material.heldout
        episodes = recorded(heldout, self.device, EVALUATION_EPISODES)
        report = measure(model, episodes)
        self.metrics, self.tasks = report.metrics, report.tasks
        found = self.metrics | scalars(self.tasks)
        self.recorder.scalars(step, {f"heldout/{k}": v for k, v in found.items()})
        if config.tensorboard:
            for name, picture in draw(report).items():
                self.recorder.picture(step, f"heldout/{name}", picture)

    def save(self, model: WorldModel) -> Path:
        """Write a checkpoint: the model as artefact, and the training state."""
        partial = begin_checkpoint(self.output, self.learner.step)
        found = {"heldout": self.metrics, "heldout_tasks": self.tasks}
        provenance = self.provenance | {"step": self.learner.step, **found}
        save_artefact(partial / "pretrained_model", model, self.config.planner, provenance)
        state = {"learner": self.learner.state_dict(), "stream": self.material.stream.state_dict()}
        return finish_checkpoint(partial, state)

    def _summary(self, terms: dict[str, Any], bar: Any, frames: int) -> dict[str, str]:
        summary = {"loss": f"{float(terms['loss/total']):.3f}"}
        if bar.format_dict["rate"]:
            summary["frames/s"] = f"{bar.format_dict['rate'] * frames:.0f}"
        if "value/r2" in self.metrics:
            summary["heldout_r2"] = f"{self.metrics['value/r2']:.3f}"
        return summary

    def _last_words(self, final: Path, stopped: bool) -> str:
        lines = [f"  {name:<20} {value:.4f}" for name, value in sorted(self.metrics.items())]
        state = "stopped early" if stopped else "done"
        artefact = final / "pretrained_model"
        return "\n".join(
            [
                f"{PROG}: {state} at step {self.learner.step}; on held-out episodes:",
                *lines,
                table(self.tasks),
                f"artefact: {artefact}",
                f"continue: {PROG} --output_dir={self.output} --resume"
                if stopped
                else f"next: egovcp-eval --policy.path={artefact} --task=... --output_dir=...",
            ]
        )


def _prepare_output(config: TrainConfig) -> Path:
    """Refuse a bad destination before any work starts."""
    if min(config.steps, config.batch_size, config.log_freq, config.save_freq) < 1:
        raise UsageError("--steps, --batch_size, --log_freq and --save_freq must be at least 1")
    return prepare_output(config.output_dir, config.resume)


def _restore(output: Path, learner: Learner, stream: Ahead) -> None:
    """Continue from the last checkpoint.

    Raises:
        ArtefactError: its networks are not those of the options.
        DataError: the dataset is another one.
        UsageError: the windows are others.
    """
    state = load_training_state(output)
    try:
        learner.load_state_dict(state["learner"])
        stream.load_state_dict(state["stream"])
    except (KeyError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ArtefactError(
            f"{output}: its checkpoint does not fit the --policy options given ({reason}); resume "
            "without them, or start a new run"
        ) from error


def _provenance(material: Material) -> dict[str, Any]:
    readers = material.readers
    return {
        "controller_id": readers[0].controller_id,
        "tasks": sorted(set(EpisodeIndex.of(readers).tasks)),
        "versions": versions(),
        "datasets": [
            {"repo_id": r.source.repo_id, "revision": r.source.commit, "episodes": r.episodes}
            for r in readers
        ],
        "heldout_episodes": describe_heldout(readers),
        "return_scales": {task: list(scale) for task, scale in material.return_scales.items()},
        "train_config": draccus.encode(material.config),
        "command": [PROG, *sys.argv[1:]],
    }
