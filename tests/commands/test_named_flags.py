"""Help texts and source code name only flags that exist."""

from __future__ import annotations

import ast
import io
import re
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path

import pytest

from egovcp.flags import flags_of

from .listing import all_commands

ROOT = Path(__file__).resolve().parents[2]
FLAG = re.compile(r"(?<![\w.-])--[a-z]\w*(?:\.\w+)*")
#: Of every command; and what stands for any name.
COMMON = {"--debug", "--help", "--version", "--config_path", "--name", "--group.option", "--a"}
#: Flags of other programs that our code starts or names.
FOREIGN = {"--bind", "--port", "--serve", "--web", "--expect", "--user", "--pdeathsig"}
APPLICATIONS = {
    "collect": ("egovcp-collect", "egovcp-dataset"),
    "train": ("egovcp-train", "egovcp-push", "egovcp-export", "egovcp-eval-"),
    "deploy": (
        *("egovcp-deploy", "egovcp-eval", "egovcp-compare", "egovcp-mcap", "egovcp-depth"),
        *("egovcp-fake", "egovcp-demo", "egovcp-task"),
    ),
    "experiment": ("egovcp-",),
    "egovcp": ("egovcp-",),
}


@cache
def _flags_of_programs(*prefixes: str) -> set[str]:
    """Flags of the commands whose names begin so."""
    return {
        flag
        for command in all_commands()
        if command.prog.startswith(prefixes)
        for flag in flags_of(command.config_class)
    }


def _is_known(flag: str, known: set[str]) -> bool:
    """It exists, or it begins the names of several: ``--env.*``."""
    return flag in known or any(other.startswith(f"{flag}.") for other in known)


def _named(text: str, own: set[str]) -> Iterator[str]:
    """Flags in a text that are not those of the command that it names before them."""
    for line in text.splitlines():
        program, is_list = "", False
        for word in re.split(r"[\s`'\",;()]+", line):
            if re.match(r"egovcp-\w|lerobot-\w|docker|pip|uv", word):
                program = word
            is_list = is_list or "[--" in word
            for flag in FLAG.findall(word.replace(".NAME", "")):
                other = _flags_of_programs(program) if program.startswith("egovcp-") else own
                if is_list:  # of flags for another command
                    other = _flags_of_programs("egovcp-")
                foreign = bool(program) and not program.startswith("egovcp-")
                if not foreign and not _is_known(flag, own | other | COMMON):
                    yield flag
            is_list = is_list and "]" not in word


@cache
def _help(main: object, arguments: tuple[str, ...], topic: str = "--help=all") -> str:
    printed = io.StringIO()
    with redirect_stdout(printed), pytest.raises(SystemExit):
        main([*arguments, topic])  # type: ignore[operator]
    return printed.getvalue()


@pytest.mark.parametrize("topic", ["--help", "--help=all"])
def test_help_names_only_flags_of_its_command(topic: str) -> None:
    wrong = []
    for command in all_commands():
        text = re.sub(r"-\n\s+", "-", _help(command.main, command.arguments, topic))
        text = " ".join(text.split())
        for flag in _named(text, set(flags_of(command.config_class))):
            wrong.append(f"{command.prog} --help names {flag}")
    assert not wrong, "\n".join(wrong)


def test_help_of_every_command_has_at_most_80_lines() -> None:
    texts = {c.prog: _help(c.main, c.arguments, "--help") for c in all_commands()}
    assert {prog: text.count("\n") for prog, text in texts.items() if text.count("\n") > 80} == {}


@pytest.mark.parametrize("application", APPLICATIONS)
def test_code_names_only_flags_of_its_commands(application: str) -> None:
    known = _flags_of_programs(*APPLICATIONS[application])
    wrong = []
    for path in sorted((ROOT / application).rglob("*.py")):
        own_parser = "import argparse" in path.read_text(encoding="utf-8")
        if own_parser or {"testing", "studies"} & set(path.parts):
            continue  # other programs than the console commands
        for line, text in _strings(path):
            for flag in _named(text, known | FOREIGN):
                wrong.append(f"{path.relative_to(ROOT)}:{line} names {flag}")
    assert not wrong, "\n".join(wrong)


def _strings(path: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of every string that a user may see, the parts of an f-string joined."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    hidden = {id(text) for node in ast.walk(tree) for text in _docstring(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [p.value if isinstance(p, ast.Constant) else "~" for p in node.values]
            yield node.lineno, "".join(map(str, parts))
            hidden |= {id(part) for part in node.values}
        elif isinstance(node, ast.Constant) and id(node) not in hidden:
            yield node.lineno, str(node.value)


def _docstring(node: ast.AST) -> Iterator[ast.expr]:
    """That of a module or a function; those of classes are help texts."""
    if isinstance(node, ast.Module | ast.FunctionDef) and node.body:
        first = node.body[0]
        if isinstance(first, ast.Expr):
            yield first.value
