"""A child process ends with its parent, even when the parent is killed."""

from __future__ import annotations

import subprocess
import sys

import psutil

_PARENT = """
import subprocess, sys, time
from egovcp.parent_death import command
child = subprocess.Popen(command("/bin/sleep", "1000"), stdin=subprocess.DEVNULL)
print(child.pid, flush=True)
time.sleep(1000)
"""


def test_a_child_ends_when_its_parent_is_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _PARENT], stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        while "sleep" not in child.name():  # it has become the program
            pass
        parent.kill()
        child.wait(timeout=60)
