"""What all tests share: one computing thread each, and Ctrl-C as a terminal has it."""

import os
import signal
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: tests are many and small
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.hub import FakeHub, redirect_hub

# a shell that starts the tests in the background has them, and what they start, ignore it
signal.signal(signal.SIGINT, signal.default_int_handler)


_SCHEDULING = os.sched_getscheduler(0), os.sched_getparam(0)


@pytest.fixture(autouse=True)
def process_settings() -> Iterator[None]:
    """Restore what a test may change in its process.

    Commands set the handler of Ctrl-C and the number of torch's threads. As root, SVT-AV1 gives a
    thread that encodes a video real-time priority for good, and other threads starve.
    """
    handler = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, handler)
    os.sched_setscheduler(0, *_SCHEDULING)
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))


@pytest.fixture
def mount_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder that the system reports as a mount point."""
    root, is_mount = tmp_path / "mnt", os.path.ismount
    root.mkdir()
    monkeypatch.setattr("os.path.ismount", lambda path: Path(path) == root or is_mount(path))
    return root


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[FakeHub]:
    """A fake Hub, to which this process's libraries talk, with all caches in ``tmp_path``."""
    with (
        FakeHub(tmp_path / "hub") as hub,
        redirect_hub(hub.endpoint, tmp_path / "home"),
    ):
        yield hub
