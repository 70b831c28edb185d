"""The device of a run, its memory, and freed memory, which is reused without page faults."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from egovcp.errors import ArtifactError, EnvironmentFailure, UsageError
from egovcp_train import checkpoint, device
from egovcp_train.loop import Learner
from egovcp_train.train import main
from tests.support.arguments import Arguments

PROGRAM = """
import resource
import numpy as np
from egovcp_train.device import keep_freed_memory
if not keep_freed_memory():
    raise SystemExit(77)
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
np.ones(1_000_000)
before = faults()
for _ in range(10):
    np.ones(1_000_000)
print(faults() - before)
"""


@pytest.mark.parametrize("name", ["meta", "hpu"])
def test_a_device_that_cannot_be_used_is_refused(name: str) -> None:
    with pytest.raises(
        EnvironmentFailure, match=rf"--device={name} cannot be used \(.*--device=cpu"
    ):
        device.choose_device(name)
    with pytest.raises(UsageError, match="unknown --device"):
        device.choose_device("abacus")


def _fill_gpu(*_: object) -> None:
    raise torch.OutOfMemoryError("CUDA out of memory")


def _fill_cpu(*_: object) -> None:
    torch.empty(1 << 55)


@pytest.mark.parametrize("fill", [_fill_gpu, _fill_cpu])
def test_a_full_device_is_an_environment_failure(
    arguments: Arguments,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    fill: Callable[..., None],
) -> None:
    monkeypatch.setattr(Learner, "update", fill)
    assert main(arguments(tmp_path / "run")) == 5
    assert "); lower --batch_size, or end other programs" in capsys.readouterr().err


@pytest.mark.parametrize("fill", [_fill_gpu, _fill_cpu])
def test_a_full_memory_is_not_reported_as_a_wrong_option(
    tmp_path: Path, fill: Callable[..., None]
) -> None:
    with pytest.raises(RuntimeError, match="memory"), checkpoint.restoring(tmp_path):
        fill()
    with (
        pytest.raises(ArtifactError, match=r"not fit .* \(KeyError: 'step'\)"),
        checkpoint.restoring(tmp_path),
    ):
        raise KeyError("step")


def _faults() -> int:
    found = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    if found.returncode == 77:
        pytest.skip("not glibc")
    assert found.returncode == 0, found.stderr
    return int(found.stdout)


@pytest.mark.slow
def test_memory_that_was_freed_is_used_again_without_page_faults() -> None:
    assert _faults() < 100  # of 8 MB ten times, each some thousand pages


def test_a_c_library_without_the_setting_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device.ctypes, "CDLL", lambda name: object())
    assert not device.keep_freed_memory()
