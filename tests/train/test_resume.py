"""Stopped, killed, resumed: the run goes on as if nothing had happened."""

import contextlib
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import draccus
import pytest
import torch

from egovcp.artifact import load_artifact
from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, Provenance
from egovcp.errors import UsageError
from egovcp.files import sha256
from egovcp.model import Batch
from egovcp.model.privileged_value import PrivilegedValue
from egovcp_train import checkpoint, privileged_value
from egovcp_train.checkpoint import load_training_state, new_checkpoint
from egovcp_train.config import TrainConfig
from egovcp_train.loop import Budget, Learner
from egovcp_train.train import main
from tests.support.arguments import Arguments


def _stop_after(monkeypatch: pytest.MonkeyPatch, step: int, number: int) -> None:
    """Send this process a signal during the given update."""
    update = Learner.update

    def interrupted(self: Learner, batch: Batch, progress: float) -> dict[str, torch.Tensor]:
        if self.step + 1 == step:
            signal.raise_signal(number)
        return update(self, batch, progress)

    monkeypatch.setattr(Learner, "update", interrupted)


def _state(output: Path) -> dict[str, Any]:
    """What the checkpoint holds, without how long it took to get there."""
    times = ("seconds", "fit_seconds")
    return {k: v for k, v in load_training_state(output).items() if k not in times}


def _equal(a: object, b: object) -> bool:
    """Bit for bit, through dictionaries and lists."""
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and torch.equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(_equal(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(_equal, a, b))
    return a == b


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, arguments: Arguments) -> Path:
    """A run of six steps with checkpoints at 3 and 6; tests must not change it."""
    output = tmp_path_factory.mktemp("resume") / "straight"
    assert main(arguments(output)) == 0
    return output


# --- going on -------------------------------------------------------------------------------
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_that_is_resumed_equals_an_uninterrupted_one(
    arguments: Arguments,
    finished: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    number: int,
) -> None:
    output = tmp_path / "run"
    handlers = [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)]
    with monkeypatch.context() as patched:
        _stop_after(patched, 4, number)
        assert main(arguments(output)) == 130  # as all commands that a signal ends
    said = capsys.readouterr().out
    assert "stopped early at step 4" in said
    command = next(line for line in said.splitlines() if line.startswith("continue: "))
    assert _state(output)["learner"]["step"] == 4
    load_artifact(str(output / "checkpoints" / "last" / "pretrained_model"))
    assert [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)] == handlers

    assert main(command.removeprefix("continue: egovcp-train ").split()) == 0
    assert _equal(_state(output), _state(finished))
    weights = "checkpoints/last/pretrained_model/model.safetensors"
    assert (output / weights).read_bytes() == (finished / weights).read_bytes()


def test_signal_in_the_last_step_does_not_change_the_finished_policy(
    arguments: Arguments,
    finished: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    output = tmp_path / "run"
    with monkeypatch.context() as patched:
        _stop_after(patched, 6, signal.SIGINT)
        assert main(arguments(output)) == 0
    assert "done at step 6" in capsys.readouterr().out
    weights = "checkpoints/last/pretrained_model/model.safetensors"
    assert (output / weights).read_bytes() == (finished / weights).read_bytes()


# --- other places -----------------------------------------------------------------------------
@pytest.fixture
def begun(
    arguments: Arguments, dataset_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A run of three steps whose dataset was named relative to the working directory."""
    shutil.copytree(dataset_root, tmp_path / "data" / "small")
    monkeypatch.chdir(tmp_path / "data")
    output = tmp_path / "run"
    assert main(arguments(output, dataset__root="small", steps=3)) == 0
    monkeypatch.chdir(tmp_path)
    return output


def test_a_run_is_resumed_from_another_working_directory(begun: Path, tmp_path: Path) -> None:
    options = (begun / "train_config.yaml").read_text()
    assert f"root: {tmp_path / 'data' / 'small'}" in options
    assert main(["--output_dir=run", "--resume", "--steps=6"]) == 0
    assert _state(begun)["learner"]["step"] == 6


def test_a_moved_dataset_is_named_with_the_flag_and_its_new_place_is_accepted(
    begun: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "data").rename(tmp_path / "moved")
    assert main(["--output_dir=run", "--resume", "--steps=6"]) == 3
    message = capsys.readouterr().err.strip()
    assert len(message.splitlines()) == 1
    assert f"no dataset at {tmp_path / 'data' / 'small'}" in message
    assert "resume with --dataset.root=FOLDER" in message
    moved = "--dataset.root=moved/small"
    assert main(["--output_dir=run", "--resume", "--steps=6", moved]) == 0
    assert _state(begun)["learner"]["step"] == 6
    assert f"root: {tmp_path / 'moved' / 'small'}" in (begun / "train_config.yaml").read_text()


def test_another_dataset_of_the_same_scenarios_does_not_continue_a_run(
    begun: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reader = DatasetReader.open(DatasetConfig(root=str(tmp_path / "data" / "small")))
    with DatasetWriter(tmp_path / "other", Provenance(reader.controller_id, seed=0)) as writer:
        for episode in reader:
            writer.add(replace(episode, reward=episode.reward + 1))
    flags = ["--output_dir=run", "--resume", "--steps=6", "--dataset.root=other"]
    assert main(flags) == 3
    assert "its episodes are not those that the run was started with" in capsys.readouterr().err


def test_a_moved_one_of_several_datasets_is_named_with_the_flag(
    arguments: Arguments,
    dataset_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in ("a", "b"):
        shutil.copytree(dataset_root, tmp_path / name)
    output = tmp_path / "run"
    both = "[{{root: {0}/a, weight: 2}}, {{root: {0}/{1}, weight: 1}}]"
    datasets = both.format(tmp_path, "b")
    assert main(arguments(output, dataset__root=None, datasets=datasets, steps=3)) == 0
    (tmp_path / "b").rename(tmp_path / "c")
    assert main([f"--output_dir={output}", "--resume", "--steps=6"]) == 3
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert f"no dataset at {tmp_path / 'b'}" in message
    assert "resume with --datasets=[{root: FOLDER, ...}, ...]" in message
    moved = f"--datasets={both.format(tmp_path, 'c')}"
    assert main([f"--output_dir={output}", "--resume", "--steps=6", moved]) == 0


def test_a_second_signal_is_obeyed_at_once(
    arguments: Arguments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def twice(self: Learner, batch: Batch, progress: float) -> dict[str, torch.Tensor]:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("went on")

    monkeypatch.setattr(Learner, "update", twice)
    assert main(arguments(tmp_path / "run")) == 130


def test_a_resumed_run_has_the_minutes_that_were_left(
    arguments: Arguments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fit of the privileged value, 30 s here, counts, but progress begins after it."""
    now, progress_seen = [0.0], list[float]()
    monkeypatch.setattr("egovcp_train.train.Budget", partial(Budget, clock=lambda: now[0]))
    update, fit = Learner.update, privileged_value.fit

    def slow_fit(*args: Any) -> PrivilegedValue:
        now[0] += 30.0
        return fit(*args)

    monkeypatch.setattr(privileged_value, "fit", slow_fit)

    def slow(self: Learner, batch: Batch, progress: float) -> dict[str, torch.Tensor]:
        now[0] += 60.0
        progress_seen.append(progress)
        return update(self, batch, progress)

    monkeypatch.setattr(Learner, "update", slow)
    output = tmp_path / "run"
    with monkeypatch.context() as patched:
        _stop_after(patched, 2, signal.SIGTERM)
        options = {"steps": 1000, "save_freq": 1000, "max_minutes": 5}
        assert main(arguments(output, **options)) == 130
    assert load_training_state(output)["seconds"] == 150.0
    now[0] += 3600.0  # a pause is no training
    assert main([f"--output_dir={output}", "--resume"]) == 0
    assert _state(output)["learner"]["step"] == 5
    assert progress_seen == pytest.approx([60 * step / 270 for step in range(5)])


def test_a_checkpoint_without_the_time_of_the_fit_is_resumed(
    finished: Path, tmp_path: Path
) -> None:
    output = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True))
    state = load_training_state(output)
    del state["fit_seconds"]
    _replace_state(output, state)
    assert main([f"--output_dir={output}", "--resume", "--steps=7"]) == 0
    assert load_training_state(output)["fit_seconds"] == 0.0


def test_a_finished_run_can_be_extended(finished: Path, tmp_path: Path) -> None:
    output = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True))
    assert main([f"--output_dir={output}", "--resume", "--steps=8"]) == 0
    state = _state(output)
    assert state["learner"]["step"] == 8
    with (output / "train_config.yaml").open(encoding="utf-8") as file:
        kept = draccus.load(TrainConfig, file)
    assert (kept.steps, kept.resume, kept.policy.hidden) == (8, False, 32)
    assert not _equal(state["learner"]["model"], _state(finished)["learner"]["model"])


def test_resuming_a_finished_run_changes_no_checkpoint(finished: Path, tmp_path: Path) -> None:
    output = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True))
    assert main([f"--output_dir={output}", "--resume"]) == 0
    assert _equal(_state(output), _state(finished))
    before = sorted(p.name for p in (finished / "checkpoints").iterdir())
    assert sorted(p.name for p in (output / "checkpoints").iterdir()) == before


@pytest.mark.parametrize("flag", ["--resume=true", "--resume=Yes", "--resume=on"])
def test_resume_takes_the_stored_options_for_every_boolean(tmp_path: Path, flag: str) -> None:
    stored = f"output_dir: {tmp_path}\nsteps: 123\n"
    (tmp_path / checkpoint.CONFIG_FILE).write_text(stored)
    argv = [f"--output_dir={tmp_path}", flag]
    assert checkpoint.resumed_options(TrainConfig, argv)["steps"] == 123
    assert checkpoint.resumed_options(TrainConfig, [*argv, "--resume=off"]) == {}
    with pytest.raises(UsageError, match=r"--resume=2: expected true or false"):
        checkpoint.resumed_options(TrainConfig, [*argv, "--resume=2"])


def test_resume_finds_the_options_in_the_home_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / checkpoint.CONFIG_FILE).write_text("output_dir: run\nsteps: 123\n")
    assert checkpoint.resumed_options(TrainConfig, ["--output_dir=~", "--resume=true"])["steps"]


# --- refusals -------------------------------------------------------------------------------
def _refused(argv: list[str], code: int, capsys: pytest.CaptureFixture[str], message: str) -> None:
    capsys.readouterr()
    assert main(argv) == code
    last_line = capsys.readouterr().err.splitlines()[-1]
    assert last_line.startswith("egovcp-train: error: ")
    assert message in last_line


def test_without_a_checkpoint_there_is_nothing_to_resume(
    arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _refused(arguments(tmp_path / "run", "--resume"), 4, capsys, "no checkpoint to resume from")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("damage", [b"", b"not a checkpoint", None])
def test_a_damaged_checkpoint_is_named(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: bytes | None
) -> None:
    output = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True))
    path = output / "checkpoints" / "last" / "training_state" / checkpoint.STATE_FILE
    path.write_bytes(path.read_bytes()[:5000] if damage is None else damage)
    _refused([f"--output_dir={output}", "--resume"], 4, capsys, checkpoint.STATE_FILE)


@pytest.mark.parametrize(
    ("flag", "code", "message"),
    [
        ("--policy.hidden=48", 4, "does not fit the options"),
        ("--sampling.length=5", 2, "length 6 -> 5"),
        ("--dataset.root=/absent", 3, "no dataset at /absent"),
        ("--preset=paper", 2, "preset debug, and --preset=paper would change nothing"),
        ("--returns.gamma=0.9", 2, "--returns.gamma=0.9, but the Q of the run in"),
        ("--returns.scale=none", 2, "was trained with dataset"),
    ],
)
def test_resuming_with_what_does_not_fit_is_refused(
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    flag: str,
    code: int,
    message: str,
) -> None:
    output = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True))
    kept = (output / "train_config.yaml").read_bytes()
    _refused([f"--output_dir={output}", "--resume", flag], code, capsys, message)
    assert (output / "train_config.yaml").read_bytes() == kept
    assert _equal(_state(output), _state(finished))


@pytest.mark.parametrize("name", ["datasets", "stream", "seconds", "critic"])
def test_a_checkpoint_of_another_version_is_refused(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    output = Path(shutil.copytree(finished, tmp_path / "run", symlinks=True))
    state = load_training_state(output)
    del (state if name in state else state["learner"])[name]
    _replace_state(output, state)
    _refused([f"--output_dir={output}", "--resume"], 4, capsys, name)


def _replace_state(output: Path, state: dict[str, object]) -> None:
    folder = output / "checkpoints" / "last" / "training_state"
    torch.save(state, folder / checkpoint.STATE_FILE)
    digest = sha256(folder / checkpoint.STATE_FILE)
    (folder / checkpoint.DIGEST_FILE).write_text(f"{digest}  {checkpoint.STATE_FILE}\n")


def test_resuming_with_a_config_file_is_refused(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Which of the two would win? Even the run's own file may lie in another folder by now."""
    file = f"--config_path={finished / 'train_config.yaml'}"
    _refused([f"--output_dir={finished}", "--resume", file], 2, capsys, "drop it")
    _refused([file, "--resume=true"], 2, capsys, "--output_dir")


# --- killed while a checkpoint is written -----------------------------------------------------
class _Killed(BaseException):
    """The process is gone: nothing after it runs."""


CALLS = ("mkdir", "rename", "replace", "symlink_to", "unlink", "open")


@contextlib.contextmanager
def _killed_at(call: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Die before the ``call``-th change to the file system; lists the changes made."""
    made: list[str] = []

    def mortal(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            if len(made) == call:
                raise _Killed
            made.append(name)
            return original(*args, **kwargs)

        return run

    with monkeypatch.context() as patched:
        for name in CALLS:
            patched.setattr(Path, name, mortal(name, getattr(Path, name)))
        for module, name in ((shutil, "rmtree"), (torch, "save"), (os, "fsync")):
            patched.setattr(module, name, mortal(name, getattr(module, name)))
        yield made


def _write(output: Path, step: int) -> None:
    with new_checkpoint(output, step, {"step": step}) as folder:
        (folder / "config.json").write_text(str(step))


def _complete(output: Path) -> int:
    """The step of the last checkpoint, which must be whole."""
    step = int(load_training_state(output)["step"])
    folder = output / "checkpoints" / "last" / "pretrained_model"
    assert (folder / "config.json").read_text() == str(step)
    return step


def test_killed_at_any_moment_the_last_checkpoint_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes = []
    for call in range(100):
        output = tmp_path / str(call)
        _write(output, 1)
        with _killed_at(call, monkeypatch) as made:
            try:
                _write(output, 2)
                survived = True
            except _Killed:
                survived = False
        outcomes.append(_complete(output))
        _write(output, 3)  # leftovers do no harm
        assert _complete(output) == 3
        assert not list((output / "checkpoints").glob("*.partial"))
        if survived:
            break
    assert outcomes[0] == 1
    assert outcomes[-1] == 2
    assert outcomes == sorted(outcomes)
    assert {"mkdir", "save", "fsync", "rename", "symlink_to", "replace"} <= set(made)


def test_a_failing_checkpoint_leaves_the_one_before_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    _write(tmp_path, 1)
    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(OSError, match="No space left"):
        _write(tmp_path, 2)
    assert _complete(tmp_path) == 1
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"000001", "last"}


def test_a_checkpoint_left_over_by_a_killed_run_is_written_again(tmp_path: Path) -> None:
    """Complete, but not yet the last when the run died."""
    _write(tmp_path, 1)
    _write(tmp_path, 2)
    link = tmp_path / "checkpoints" / "last"
    link.unlink()
    link.symlink_to("000001")
    assert _complete(tmp_path) == 1
    _write(tmp_path, 2)
    assert _complete(tmp_path) == 2
