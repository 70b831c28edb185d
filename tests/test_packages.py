"""Each distribution declares what it imports, and names the extra that is missing."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from importlib import import_module, metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from egovcp.errors import EnvironmentFailure
from egovcp.packages import DISTRIBUTIONS, distribution_of
from tests.support.limited import LimitedResult, run_limited
from tests.support.requirements import required_distributions

ROOT = Path(__file__).resolve().parents[1]
#: Distribution -> folder of its pyproject.toml.
PROJECTS = {
    "egovcp": ROOT,
    **{f"egovcp-{name}": ROOT / name for name in ("collect", "train", "deploy", "experiment")},
    **{path.name: path for path in sorted((ROOT / "plugins").iterdir())},
}
PROGRAMS = {
    entry.name: distribution
    for distribution in PROJECTS
    for entry in metadata.entry_points(group="console_scripts")
    if entry.dist is not None and canonicalize_name(entry.dist.name) == distribution
}


def declared(project: Path) -> set[str]:
    """Distributions that a pyproject.toml names as dependencies or in extras."""
    table = tomllib.loads((project / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = table.get("optional-dependencies", {}).values()
    texts = [*table["dependencies"], *(text for extra in extras for text in extra)]
    return {canonicalize_name(Requirement(text).name) for text in texts}


def imported(source: str) -> set[str]:
    """Top-level modules that a file imports when it runs, wherever in its code."""
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                found.update(alias.name.partition(".")[0] for alias in child.names)
            elif isinstance(child, ast.ImportFrom) and child.module and not child.level:
                found.add(child.module.partition(".")[0])
            if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
                for other in child.orelse:
                    visit(other)
                continue
            visit(child)

    visit(ast.parse(source))
    return found - sys.stdlib_module_names


@pytest.mark.parametrize("distribution", PROJECTS)
def test_every_import_is_declared(distribution: str) -> None:
    project = PROJECTS[distribution]
    package = distribution.replace("-", "_")
    files = sorted((project / package).rglob("*.py"))
    assert files
    names = {module for file in files for module in imported(file.read_text(encoding="utf-8"))}
    needed = {distribution_of(name.replace("egovcp_", "egovcp-")) for name in names}
    assert needed - declared(project) - {canonicalize_name(distribution)} == set()


def test_an_import_is_found_anywhere_but_for_type_checkers() -> None:
    source = (
        "import os, torch.nn\n"
        "if TYPE_CHECKING:\n    import pandas\n"
        "def f():\n    from pyarrow.parquet import write_table\n    from . import other\n"
    )
    assert imported(source) == {"torch", "pyarrow"}


def absent_modules(distribution: str) -> Iterator[str]:
    """Top-level modules that are not there where only this distribution is installed."""
    present = required_distributions(distribution)
    owners = {**metadata.packages_distributions(), **{m: [d] for m, d in DISTRIBUTIONS.items()}}
    for module, distributions in owners.items():
        if not present.intersection(map(canonicalize_name, distributions)):
            yield module


def alone(program: str, *args: str) -> LimitedResult:
    """The result of a program where only its distribution is installed."""
    (entry,) = metadata.entry_points(group="console_scripts", name=program)

    def run() -> int:
        absent = set(absent_modules(PROGRAMS[program]))
        for name in [*sys.modules]:
            top = name.partition(".")[0]
            if top in absent or (top == "egovcp" or top.startswith("egovcp_")):
                del sys.modules[name]
        sys.modules.update(dict.fromkeys(absent))  # type: ignore[arg-type]
        module, _, name = entry.value.partition(":")
        code: int = getattr(import_module(module), name)(args)
        return code

    return run_limited(run, seconds=120, memory_bytes=16 << 30)


def names_the_extra(result: LimitedResult) -> bool:
    """Whether it is one line with the command that installs what is missing."""
    line = r"egovcp-[a-z0-9 -]+: error: [^\n]* not installed; install it: pip install [^\n]+\n"
    return re.fullmatch(line, result.output) is not None


#: Command line of a distribution that is installed alone -> the extra that it needs.
NEED_EXTRAS = {
    "egovcp-dataset viz data --output=out": "egovcp-collect[viz]",
    "egovcp-deploy --policy.path=policy --robot.type=sim --output_dir=out": "egovcp-deploy[sim]",
    "egovcp-demo": "egovcp-deploy[sim]",
    "egovcp-eval --policy.path=policy --task=ball --output_dir=out": "egovcp-deploy[sim]",
    "egovcp-eval-lowlevel --output_dir=out": "egovcp-train[sim]",
    "egovcp-fake-g1 --task=ball": "egovcp-deploy[sim]",
    "egovcp-mcap to-dataset run.mcap --dataset.root=out": "egovcp-deploy[data]",
    "egovcp-task check ball": "egovcp-deploy[sim]",
    "egovcp-train --dataset.root=data --output_dir=out --eval_closed_loop=1": "egovcp-train[sim]",
    "egovcp-train --dataset.root=data --output_dir=out --wandb.enable": "egovcp-train[wandb]",
    "egovcp-train --dataset.root=data --output_dir=out --trackio=mine": "egovcp-train[trackio]",
    "egovcp-train-lowlevel --output_dir=out": "egovcp-train[lowlevel]",
    "egovcp-train-ppo --task=ball --output_dir=out": "egovcp[sim]",
}


@pytest.mark.slow
@pytest.mark.parametrize("line", NEED_EXTRAS)
def test_alone_a_program_refuses_work_that_needs_an_extra(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "data").mkdir()
    monkeypatch.chdir(tmp_path)
    program, *args = line.split()
    result = alone(program, *args)
    assert result.exit_code == EnvironmentFailure.exit_code, result.output
    assert names_the_extra(result), result.output
    assert f"'{NEED_EXTRAS[line]}'" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
