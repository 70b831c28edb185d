"""The entry points: the command, or one line about what is missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from egovcp_deploy.robots import entry


@pytest.mark.parametrize("name", ["fake_g1", "depth_server"])
def test_they_lead_to_the_commands(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        getattr(entry, name)(["--help"])
    assert stopped.value.code == 0
    assert "egovcp-" in capsys.readouterr().out


def test_a_missing_package_is_named() -> None:
    code = "sys.modules['mujoco'] = None; from egovcp_deploy.robots.entry import fake_g1"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; {code}; sys.exit(fake_g1(['--help']))"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 5
    assert "mujoco is not installed" in done.stderr
    assert "Traceback" not in done.stderr
