"""Completion scripts, run by the shells that they are for."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import get_args

import pytest

from egovcp.completion import Shell, completion_script

#: A line that bash completes -> what it puts into COMPREPLY.
BASH = {
    "egovcp-collect --bound": ["--boundary=reflect", "--boundary=clip"],
    "egovcp-collect --boundary=r": ["reflect"],
    "egovcp-collect --dataset.ro": ["--dataset.root="],
    "egovcp-dataset c": ["check", "coverage", "card"],
    "egovcp-dataset check --max": ["--max_problems="],
    "egovcp-dataset info --json=rep": ["report.json"],
    "/usr/bin/egovcp-experiment table1 --sca": ["--scale=smoke", "--scale=small", "--scale=paper"],
}
_BASH_DRIVER = """
source "$1"; COMP_LINE=$2; COMP_POINT=${#2}
read -ra COMP_WORDS <<< "${2//=/ = }"; COMP_CWORD=$(( ${#COMP_WORDS[@]} - 1 ))
_egovcp; printf '%s\\n' "${COMPREPLY[@]}"
"""
_ZSH_DRIVER = """
compadd() { print -r -- ${(P)@[-1]}; }; compdef() {}; typeset -A compstate=(nmatches 1)
source "$1"; words=(${=2}); CURRENT=${#words}; _egovcp
"""


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("scripts")
    paths = {shell: folder / shell for shell in get_args(Shell)}
    for shell, path in paths.items():
        path.write_text(completion_script(shell) + "\n", encoding="utf-8")
    return paths


def _run(folder: Path, *argv: str | Path) -> list[str]:
    result = subprocess.run(argv, cwd=folder, capture_output=True, text=True, check=True)
    assert result.stderr == ""
    return result.stdout.splitlines()


def test_bash_completes_subcommands_flags_values_and_files(
    scripts: dict[str, Path], tmp_path: Path
) -> None:
    (tmp_path / "report.json").touch()
    found = {
        line: _run(tmp_path, "bash", "-c", _BASH_DRIVER, "bash", scripts["bash"], line)
        for line in BASH
    }
    assert found == BASH


@pytest.mark.skipif(not shutil.which("zsh"), reason="needs zsh")
def test_zsh_offers_subcommands_and_flags(scripts: dict[str, Path], tmp_path: Path) -> None:
    def offered(line: str) -> list[str]:
        found = _run(tmp_path, "zsh", "-fc", _ZSH_DRIVER, "zsh", scripts["zsh"], line)
        return " ".join(found).split()

    assert {"check", "push"} <= set(offered("egovcp-dataset c"))
    assert "--max_problems=" in offered("egovcp-dataset check --m")
    assert "--boundary=clip" in offered("egovcp-collect --b")


@pytest.mark.skipif(not shutil.which("fish"), reason="needs fish")
def test_fish_completes_subcommands_flags_and_values(
    scripts: dict[str, Path], tmp_path: Path
) -> None:
    def completed(line: str) -> list[str]:
        command = f"source {scripts['fish']}; complete -C '{line}'"
        return [line.partition("\t")[0] for line in _run(tmp_path, "fish", "-N", "-c", command)]

    assert completed("egovcp-dataset che") == ["check"]
    assert completed("egovcp-dataset check --max") == ["--max_problems"]
    assert set(completed("egovcp-collect --boundary=")) == {"--boundary=reflect", "--boundary=clip"}
