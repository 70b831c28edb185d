"""Checks a command line with its program's parser, without running the program."""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import runpy
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_type_hints
from unittest import mock

import egovcp.cli
from egovcp.entry_point import EntryPoint
from egovcp.flags import flags_of
from lerobot_env_egovcp import EgovcpEnvConfig
from lerobot_policy_egovcp import EgovcpConfig
from lerobot_robot_egovcp import EgovcpG1Config

ROOT = Path(__file__).resolve().parents[2]
#: LeRobot's commands that read their options into a dataclass -> that class.
_LEROBOT_CONFIGS = {
    "lerobot-eval": "lerobot.configs.eval:EvalPipelineConfig",
    "lerobot-rollout": "lerobot.rollout:RolloutConfig",
    "lerobot-train": "lerobot.configs.train:TrainPipelineConfig",
}
#: Third-party packages in documented `pip install` commands.
_PACKAGES = {"trackio", "uv", "wandb"}


class WrongCommand(Exception):
    """A program would refuse the command line."""


class _Parsed(BaseException):
    """Ends a program after its options have been parsed."""


def check(argv: Sequence[str]) -> None:
    """Raise `WrongCommand` if the program of this command line would refuse it."""
    program, *args = argv
    if not args and program not in ("make", "pip", "python"):
        main_of(program)
    elif not args:
        raise WrongCommand(f"{program}: no argument")
    elif program == "make":
        _require(args[0] in _makefile_targets(), f"make has no target {args[0]}")
    elif program == "pip":
        _check_packages(args[1:])
    elif program == "python":
        _check_script(args)
    elif program in _LEROBOT_CONFIGS:
        _check_lerobot(program, args)
    elif program == "rerun":
        main_of(program)
    else:
        _check_parser(program, args, lambda: main_of(program)(args))


def main_of(program: str) -> Callable[..., int]:
    """The function behind a console script, called with the arguments."""
    points = metadata.entry_points(group="console_scripts", name=program)
    _require(bool(points), f"there is no program {program}")
    found: Any = next(iter(points)).load()
    if isinstance(found, EntryPoint):
        return import_module(found.module).main  # type: ignore[no-any-return]
    return lambda args: found()


@cache
def known_flags() -> frozenset[str]:
    """Flags of our commands, of our plugins in LeRobot's commands, of benchmarks and studies."""
    found: set[str] = set()
    for point in metadata.entry_points(group="console_scripts"):
        if point.name.startswith("egovcp-"):
            found |= set(re.findall(r"--[\w.-]+", _help(point.name)))
    found |= {flag.replace("--", "--policy.", 1) for flag in flags_of(EgovcpConfig)}
    found |= {flag.replace("--", "--env.", 1) for flag in flags_of(EgovcpEnvConfig)}
    found |= {flag.replace("--", "--robot.", 1) for flag in flags_of(EgovcpG1Config)}
    for script in (ROOT / "benchmarks").glob("*.py"):
        text = script.read_text(encoding="utf-8")
        found |= set(re.findall(r'"(--[\w.-]+)"', text))
    for study in (ROOT / "experiment/egovcp_experiment/studies").glob("[a-z]*.py"):
        module = import_module(f"egovcp_experiment.studies.{study.stem}")
        if hasattr(module, "measure"):
            found |= set(flags_of(get_type_hints(module.measure)["config"]))
    return frozenset(found)


def _help(program: str) -> str:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        main_of(program)(["--help=all"])
    return printed.getvalue()


@cache
def _makefile_targets() -> frozenset[str]:
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    return frozenset(re.findall(r"^([a-z]+):", text, re.M))


def _check_parser(program: str, args: Sequence[str], start: Callable[[], object]) -> None:
    """Start a program whose parsers have been changed so that they end it."""

    def ending(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            function(*args, **kwargs)
            raise _Parsed

        return call

    argparser, errors = argparse.ArgumentParser, io.StringIO()
    with (
        mock.patch.object(egovcp.cli, "parse_config", ending(egovcp.cli.parse_config)),
        mock.patch.object(argparser, "parse_args", ending(argparser.parse_args)),
        mock.patch.object(sys, "argv", [program, *args]),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(errors),
    ):
        try:
            code = start()
        except _Parsed:
            return
        except SystemExit as end:
            code = end.code
    _require(not code, errors.getvalue().strip())


def _check_script(args: Sequence[str]) -> None:
    """``python -m MODULE ...`` or ``python FILE ...``."""
    module = args[0] == "-m"
    name, rest = (args[1], args[2:]) if module else (args[0], args[1:])
    exists = find_spec(name) is not None if module else (ROOT / name).is_file()
    _require(exists, f"there is no {name}")
    if not rest:
        return

    def start() -> object:
        if module:
            found = import_module(name)
            if hasattr(found, "main"):
                return found.main(rest)
            return runpy.run_module(name, run_name="__main__")
        path = ROOT / name
        with mock.patch.object(sys, "path", [str(path.parent), *sys.path]):
            return runpy.run_path(str(path), run_name="__main__")

    _check_parser(name, rest, start)


def _check_lerobot(program: str, args: Sequence[str]) -> None:
    from lerobot.configs import parser

    module, name = _LEROBOT_CONFIGS[program].split(":")

    def parsed(cfg: Any) -> None:
        """Do nothing."""

    parsed.__annotations__["cfg"] = getattr(import_module(module), name)
    errors = io.StringIO()
    with mock.patch.object(sys, "argv", [program, *args]), contextlib.redirect_stderr(errors):
        try:
            parser.wrap()(parsed)()
        except SystemExit as end:
            raise WrongCommand(errors.getvalue().strip()) from end


def _check_packages(targets: Sequence[str]) -> None:
    """Each is a package that we use, with extras that it has."""
    extras: dict[str, set[str]] = {name: set() for name in _PACKAGES}
    for file in _project_files():
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        extras[project["name"]] = set(project.get("optional-dependencies", {}))
    for target in targets:
        if target == "-e" or (ROOT / target / "pyproject.toml").is_file():
            continue
        if target.startswith("egovcp-task-"):  # written by `egovcp-task new`
            continue
        name, _, wanted = target.rstrip("]").partition("[")
        _require(name in extras, f"there is no package {name}")
        missing = {extra for extra in wanted.split(",") if extra} - extras[name]
        _require(not missing, f"{name} has no extra {', '.join(sorted(missing))}")


def _project_files() -> Iterator[Path]:
    yield ROOT / "pyproject.toml"
    for pattern in ("*/pyproject.toml", "plugins/*/pyproject.toml"):
        yield from ROOT.glob(pattern)


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise WrongCommand(message)
