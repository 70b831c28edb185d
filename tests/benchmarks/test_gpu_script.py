"""The script of all measurements on a GPU: its parts on the CPU, and its commands for a GPU."""

import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from tests.documentation.programs import check

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "gpu.sh"
NO_GPU = {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}


@pytest.mark.timeout(300)
def test_all_parts_run_without_a_gpu(tmp_path: Path) -> None:
    command = ["bash", str(SCRIPT), str(tmp_path / "out")]
    done = subprocess.run(
        command, env=os.environ | NO_GPU, capture_output=True, text=True, check=False
    )
    codes = dict(re.findall(r"^== (\w+): exit code (\d+)", done.stdout, re.M))
    parts = ("planner", "collect", "train_step", "train", "eval", "lowlevel")
    assert codes == dict.fromkeys(parts, "0"), done.stdout + done.stderr
    assert done.returncode == 0
    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 2
    assert "exists" in again.stderr


def test_the_commands_for_a_gpu_are_valid(tmp_path: Path) -> None:
    """The script with a GPU pretended, and each part printed instead of run."""
    text = SCRIPT.read_text(encoding="utf-8").replace("if python -c", "if true || python -c")
    text = re.sub(
        r"^part\(\) \{.*?^\}", "part() { printf '%q ' \"${@:2}\"; echo; }", text, flags=re.M | re.S
    )
    printed = subprocess.run(
        ["bash", "-c", text, str(SCRIPT), str(tmp_path / "out")],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    parts = [shlex.split(line) for line in printed.splitlines()]
    assert sum(int(limit) for limit, *_ in parts) <= 15 * 60
    commands = [command for _, *command in parts]
    assert [command[0] for command in commands] == [
        "python",
        "egovcp-collect",
        "python",
        "egovcp-train",
        "egovcp-eval",
        "train",
    ]
    for command in commands[:-1]:  # the last is mjlab's
        check(command)
