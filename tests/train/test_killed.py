"""Killed with SIGKILL at any moment, a run goes on from its last complete checkpoint."""

import hashlib
import multiprocessing
import os
import random
import signal
import time
from pathlib import Path

import pytest
import torch

from egovcp.artifact import load_artifact
from egovcp.model import Batch
from egovcp_train.checkpoint import load_training_state
from egovcp_train.loop import Learner
from egovcp_train.train import main
from tests.support.arguments import Arguments

_PATIENCE_S = 200.0


def _start(argv: list[str], log: Path, die_after: int | None = None) -> multiprocessing.Process:
    """A run in a process of its own; a line per step in ``log``: step, loss, hash of the batch."""
    context = multiprocessing.get_context("fork")  # it need not import everything again
    process = context.Process(target=_run, args=(argv, log, die_after))
    process.start()
    return process


def _run(argv: list[str], log: Path, die_after: int | None) -> None:
    update = Learner.update

    def noted(self: Learner, batch: Batch, progress: float) -> dict[str, torch.Tensor]:
        terms = update(self, batch, progress)
        content = b"".join(x.numpy().tobytes() for x in batch)
        with log.open("a") as file:
            digest = hashlib.sha256(content).hexdigest()
            file.write(f"{self.step} {float(terms['loss/total']).hex()} {digest}\n")
        if self.step == die_after:
            os.kill(os.getpid(), signal.SIGKILL)
        return terms

    Learner.update = noted  # type: ignore[method-assign]
    os._exit(main(argv))


def _outcome(process: multiprocessing.Process) -> int | None:
    process.join(_PATIENCE_S)
    return process.exitcode


@pytest.mark.slow
def test_200_steps_in_one_go_are_100_and_100_with_two_deaths_between(
    arguments: Arguments, tmp_path: Path
) -> None:
    options = {"steps": 200, "save_freq": 50, "batch_size": 2, "sampling__length": 4}
    straight, broken = tmp_path / "straight.txt", tmp_path / "broken.txt"
    assert _outcome(_start(arguments(tmp_path / "a", **options), straight)) == 0
    argv = arguments(tmp_path / "b", **options)
    assert _outcome(_start(argv, broken, die_after=115)) == -signal.SIGKILL
    assert _outcome(_start([*argv, "--resume"], broken, die_after=171)) == -signal.SIGKILL
    assert _outcome(_start([*argv, "--resume"], broken)) == 0

    expected = straight.read_text().splitlines()
    lived = broken.read_text().splitlines()
    assert [int(line.split()[0]) for line in expected] == list(range(1, 201))
    assert lived == expected[:115] + expected[100:171] + expected[150:]
    weights = "checkpoints/last/pretrained_model/model.safetensors"
    assert (tmp_path / "a" / weights).read_bytes() == (tmp_path / "b" / weights).read_bytes()


@pytest.mark.parametrize(
    "deaths", [3, pytest.param(100, marks=[pytest.mark.slow, pytest.mark.timeout(7200)])]
)
def test_killed_while_a_checkpoint_is_written_it_goes_on_from_the_last_complete_one(
    arguments: Arguments, tmp_path: Path, deaths: int
) -> None:
    rng = random.Random(deaths)
    output, log = tmp_path / "run", tmp_path / "log.txt"
    argv = arguments(output, steps=10**6, save_freq=1, sampling__length=2, threads=1)
    last = 0
    for death in range(deaths):
        process = _start([*argv, "--resume"] if death else argv, log)
        _wait_until_writing(output, process, rng.randint(2, 4))
        time.sleep(rng.uniform(0.0, 0.03))
        process.kill()
        assert _outcome(process) == -signal.SIGKILL
        step = _whole(output)
        assert step > last
        last = step
    begun = [int(line.split()[0]) for line in log.read_text().splitlines()]
    assert begun[0] == 1
    assert len(begun) - len(set(begun)) <= 2 * deaths  # little was done twice


def _wait_until_writing(output: Path, process: multiprocessing.Process, times: int) -> None:
    """Until a checkpoint is being written, the ``times``-th that is met in this process."""
    seen: set[str] = set()
    end = time.monotonic() + _PATIENCE_S
    known = {p.name for p in output.glob("checkpoints/*.partial")}  # left over by the last death
    while len(seen) < times:
        assert process.is_alive(), "the run ended by itself"
        assert time.monotonic() < end, "no checkpoint is written"
        seen |= {p.name for p in output.glob("checkpoints/*.partial")} - known
        time.sleep(0.0005)


def _whole(output: Path) -> int:
    """The step of the last checkpoint, which must be complete in all its parts."""
    last = output / "checkpoints" / "last"
    assert last.is_symlink()
    assert last.is_dir(), "last dangles"
    step = int(load_training_state(output)["learner"]["step"])
    assert load_artifact(str(last / "pretrained_model")).manifest["step"] == step
    assert last.resolve().name == f"{step:06d}"
    return step
