"""Generates the reference pages: every command's help and the public Python API."""

import contextlib
import io
import os
import tomllib
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType

import mkdocs_gen_files

ROOT = Path(__file__).resolve().parents[1]
#: Public modules and packages, in the order of the page.
MODULES = (
    "egovcp.spec",
    "egovcp.errors",
    "egovcp.artifact",
    "egovcp.data",
    "egovcp.hub",
    "egovcp.model",
    "egovcp.plan",
    "egovcp.sim",
    "egovcp.sim.tasks",
    "egovcp.robot",
    "egovcp.log",
    "egovcp.checks",
    "egovcp.testing",
)


def commands() -> dict[str, str]:
    """Name of each command -> its entry point, ``module:function``."""
    found: dict[str, str] = {}
    for project in sorted(ROOT.glob("**/pyproject.toml")):
        if not {".venv", "outputs", "tests"} & set(project.relative_to(ROOT).parts):
            found |= tomllib.loads(project.read_text())["project"].get("scripts", {})
    return dict(sorted(found.items()))


def help_of(entry_point: str) -> str:
    """The complete help of a command."""
    module, function = entry_point.split(":")
    command = getattr(import_module(module), function)
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(io.StringIO()):
        command(["--help=all"])
    return output.getvalue()


def members(module: ModuleType) -> list[str]:
    """What documents a module: its `__all__`, else its submodules, else itself."""
    if hasattr(module, "__all__"):
        return [f"{module.__name__}.{name}" for name in module.__all__]
    if hasattr(module, "__path__"):
        found = iter_modules(module.__path__, f"{module.__name__}.")
        return [info.name for info in found if not info.name.rpartition(".")[2].startswith("_")]
    return [module.__name__]


def write_commands() -> None:
    """One section per command."""
    os.environ["COLUMNS"] = "100"
    with mkdocs_gen_files.open("reference/commands.md", "w") as page:
        page.write("# Commands\n\nThe output of `--help=all` of every command.\n")
        for name, entry_point in commands().items():
            page.write(f"\n## {name}\n\n```text\n{help_of(entry_point)}```\n")


def write_api() -> None:
    """One section per public module."""
    with mkdocs_gen_files.open("reference/api.md", "w") as page:
        page.write("# Python API\n")
        for name in MODULES:
            module = import_module(name)
            page.write(f"\n## {name}\n\n")
            for member in members(module):
                page.write(f"::: {member}\n\n")


write_commands()
write_api()
