"""Generates the reference pages: every command's help and the public Python API."""

import contextlib
import io
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pkgutil import iter_modules
from types import ModuleType

import mkdocs_gen_files

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


def help_of(command: EntryPoint) -> str:
    """The complete help of a command; raises `SystemExit` if it fails."""
    output, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        code = command.load()(["--help=all"])
    if code:
        raise SystemExit(f"{command.name} --help=all failed: {errors.getvalue()}")
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
    scripts = sorted(entry_points(group="console_scripts"), key=lambda script: script.name)
    with mkdocs_gen_files.open("reference/commands.md", "w") as page:
        page.write("# Commands\n\nThe output of `--help=all` of every command.\n")
        for command in scripts:
            if command.name.startswith("egovcp-"):
                page.write(f"\n## {command.name}\n\n```text\n{help_of(command)}```\n")


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
