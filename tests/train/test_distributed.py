"""Several processes train as one process with the whole batch.

Started with ``torchrun``, which is what ``accelerate launch`` itself starts for several GPUs; with
``--cpu`` that one starts several processes through MPI only.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from egovcp.artifact import load_artifact
from egovcp_train.checkpoint import load_training_state
from egovcp_train.train import main

pytest.importorskip("accelerate")
pytestmark = pytest.mark.timeout(900)

type Arguments = Callable[..., list[str]]

LAUNCH = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
PADDED = {"sampling__length": 20, "log_freq": 1, "tensorboard": "true"}  # one episode has 15 ticks


def _start(argv: list[str]) -> subprocess.Popen[str]:
    command = [*LAUNCH, "-m", "egovcp_train.train", *argv]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, text=True, start_new_session=True, **pipes)


def _launch(argv: list[str]) -> tuple[int, str, str]:
    process = _start(argv)
    out, err = process.communicate(timeout=800)
    return process.returncode, out, err


def _curves(output: Path) -> dict[str, list[float]]:
    """Name -> value at each step, of the losses."""
    events = EventAccumulator(str(output / "tensorboard"))
    events.Reload()
    names = [n for n in events.Tags()["scalars"] if n.startswith("loss/") or n == "grad_norm"]
    return {name: [event.value for event in events.Scalars(name)] for name in names}


@pytest.mark.slow
def test_two_processes_have_the_losses_of_one_with_the_same_global_batch(
    arguments: Arguments, tmp_path: Path
) -> None:
    """Each holds two of four windows; the shorter episode makes their masks differ."""
    options = {**PADDED, "steps": 8, "save_freq": 8}
    code, said, complaints = _launch(arguments(tmp_path / "two", **options, batch_size=2))
    assert code == 0, complaints
    assert said.count("done at step 8") == 1  # one of them speaks
    assert main(arguments(tmp_path / "one", **options, batch_size=4)) == 0
    one, two = _curves(tmp_path / "one"), _curves(tmp_path / "two")
    assert len(load_training_state(tmp_path / "two")["streams"]) == 2
    assert one.keys() == two.keys()
    assert len(one["loss/total"]) == 8
    for name, values in one.items():
        assert two[name] == pytest.approx(values, rel=2e-3, abs=1e-5), name
    states = [load_training_state(tmp_path / n)["learner"]["model"] for n in ("one", "two")]
    for name, value in states[0].items():
        torch.testing.assert_close(states[1][name], value, rtol=1e-2, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["ram", "stream"])
def test_two_processes_that_are_resumed_go_on_exactly(
    arguments: Arguments, tmp_path: Path, mode: str
) -> None:
    straight, resumed = tmp_path / "straight", tmp_path / "resumed"
    options = {"steps": 6, "save_freq": 3, "loading__mode": mode, "loading__shuffle__episodes": 2}
    assert _launch(arguments(straight, **options))[0] == 0
    shutil.copytree(straight, resumed, symlinks=True)
    last = resumed / "checkpoints" / "last"
    shutil.rmtree(last.resolve())
    last.unlink()
    last.symlink_to("000003")
    assert len(load_training_state(resumed)["streams"]) == 2
    code, _, complaints = _launch([f"--output_dir={resumed}", "--resume"])
    assert code == 0, complaints
    weights = "checkpoints/last/pretrained_model/model.safetensors"
    assert (straight / weights).read_bytes() == (resumed / weights).read_bytes()


@pytest.mark.slow
def test_a_signal_stops_all_of_them_and_the_run_can_go_on(
    arguments: Arguments, tmp_path: Path
) -> None:
    """As Ctrl-C in a terminal: to the launcher and to both processes, then again from it."""
    output = tmp_path / "run"
    process = _start(arguments(output, steps=10**6, save_freq=2))
    end = time.monotonic() + 600
    while not (output / "checkpoints" / "last").exists():
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)
    out, _ = process.communicate(timeout=600)
    assert process.returncode != 0
    assert "stopped early at step" in out
    step = load_training_state(output)["learner"]["step"]
    folder = output / "checkpoints" / "last" / "pretrained_model"
    assert load_artifact(str(folder)).manifest["step"] == step
    argv = [f"--output_dir={output}", "--resume", f"--steps={step + 2}"]
    assert _launch(argv)[0] == 0


@pytest.mark.slow
def test_what_is_refused_is_said_once(arguments: Arguments, tmp_path: Path) -> None:
    code, out, err = _launch(arguments(tmp_path / "run", dataset__root=tmp_path / "nothing"))
    assert code != 0
    assert out == ""
    assert err.count("egovcp-train: error: no such folder") == 1
    assert not (tmp_path / "run").exists()
