"""The device of a run, and freed memory, which is reused without page faults."""

import subprocess
import sys

import pytest

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp_train import device

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
