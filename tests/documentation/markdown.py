"""DocumentedCommand lines and Python snippets of a Markdown file.

A shell block is a fenced block marked ``bash``, ``sh`` or ``shell``, or an indented block whose
lines are all commands. An inline command is a code span that begins with the name of a program.
Bash itself expands variables, loops, quotes and continuations; no program is started.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path

_SHELL = ("bash", "sh", "shell")
_PROGRAM = r"(?:egovcp|lerobot)-[a-z0-9-]+|python|pip|make|rerun"
_COMMAND = re.compile(rf"(?:[A-Z_]+=\S+ +)*(?:{_PROGRAM})(?: |$)")
_ASSIGNMENT = re.compile(r"[A-Za-z_]+=")
_FENCE = re.compile(r"\s*(`{3,}|~{3,})\s*(\w*)")
_SPAN = re.compile(r"`([^`]+)`")

#: Bash calls the function for each program that it does not find, and it finds none; a block
#: that activates an environment is an error.
_RECORD = r"""
set -f
readonly PATH
command_not_found_handle() { printf '%s\0' "$#" "$@" >&3; }
"""


@dataclass(frozen=True)
class DocumentedCommand:
    """A command line as the program would get it."""

    place: str
    """File and line of the block or span, ``README.md:55``."""
    argv: tuple[str, ...]
    inline: bool
    """Whether it stands within a sentence, where required options may be left out."""

    def __str__(self) -> str:
        return f"{self.place}: {' '.join(self.argv)}"


@dataclass(frozen=True)
class Text:
    """A piece of a Markdown file."""

    place: str
    body: str


@dataclass(frozen=True)
class Page:
    """A Markdown file, taken apart."""

    shell: tuple[Text, ...]
    python: tuple[Text, ...]
    spans: tuple[Text, ...]


def read_page(path: Path, name: str) -> Page:
    """Take a file apart; ``name`` is how places call it."""
    shell, python, prose = [], [], []
    for number, language, lines in _blocks(path.read_text(encoding="utf-8").splitlines()):
        text = Text(f"{name}:{number}", "\n".join(lines))
        if language in _SHELL or (language == "indented" and _is_shell(lines)):
            shell.append(text)
        elif language in ("python", "py"):
            python.append(text)
        elif language in ("prose", "indented"):
            prose.append(text)
    spans = [
        Text(text.place, " ".join(span.split()))
        for text in prose
        for span in _SPAN.findall(text.body)
    ]
    return Page(tuple(shell), tuple(python), tuple(spans))


def commands(page: Page) -> list[DocumentedCommand]:
    """Every command of the page, expanded."""
    inline = [span for span in page.spans if _COMMAND.match(span.body)]
    found = [c for text in page.shell for c in expanded(text, inline=False)]
    return [*found, *(c for text in inline for c in expanded(text, inline=True))]


@cache
def expanded(text: Text, inline: bool) -> tuple[DocumentedCommand, ...]:
    """What bash would start."""
    done = subprocess.run(
        ["/bin/bash", "-c", f"exec 3>&1 >/dev/null{_RECORD}{text.body}"],
        env={"PATH": "/nonexistent"},
        capture_output=True,
        check=False,
    )
    assert not done.stderr, f"{text.place}: {done.stderr.decode()}\n{text.body}"
    words = iter(done.stdout.decode().split("\0")[:-1])
    records = [tuple(islice(words, int(count))) for count in words]
    return tuple(DocumentedCommand(text.place, argv, inline) for argv in records)


def _blocks(lines: list[str]) -> Iterator[tuple[int, str, list[str]]]:
    """(number of the first line, language or ``indented`` or ``prose``, lines)."""
    start = 0
    while start < len(lines):
        fence = _FENCE.match(lines[start])
        if fence is not None:
            ends = (n for n in range(start + 1, len(lines)) if lines[n].strip() == fence[1])
            end = next(ends, len(lines))
            yield start + 2, fence[2] or "text", lines[start + 1 : end]
            start = end + 1
            continue
        kind = _kind(lines[start])
        end = start + 1
        while end < len(lines) and _kind(lines[end]) in (kind, ""):
            end += 1
        yield start + 1, kind or "prose", lines[start:end]
        start = end


def _kind(line: str) -> str:
    """What a line belongs to; empty for an empty line, which ends no block."""
    if not line.strip():
        return ""
    if _FENCE.match(line):
        return "fence"
    return "indented" if line.startswith("    ") else "prose"


def _is_shell(lines: list[str]) -> bool:
    """Whether each line, with its continuations, is a command or an assignment."""
    whole = "\n".join(line[4:] for line in lines).replace("\\\n", " ").splitlines()
    logical = [line for line in whole if line.strip() and not line.startswith("#")]
    return all(_COMMAND.match(line) or _ASSIGNMENT.match(line) for line in logical)
