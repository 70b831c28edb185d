"""Every command line in README, docs and dataset cards is one that its program accepts."""

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

import pytest

from .markdown import DocumentedCommand, Page, Text, commands, expanded, read_page
from .programs import ROOT, WrongCommand, check, known_flags

#: The lab notebook quotes commands of its day; the template is filled in before it is read.
_SKIPPED = {"docs/log.md", "dataset_cards/template.md"}
#: What stands for a name that the reader chooses -> such a name.
_PLACEHOLDERS = {
    "NAME": "ablations",
    "EXPERIMENT": "ablations",
    "TASK": "ball",
    "POLICY": "runs/ball/checkpoints/last/pretrained_model",
    "--run=RUN": "--run=eval",
    "RUN": "runs/ball",
    "COST": "0.1",
    "COMMIT": "main",
    "EDITED": "data/ball",
    "ORIGINAL": "data/ball",
    "OTHER": "eval2",
}
#: Inline commands that are part of a sentence may lack what the program requires.
_INCOMPLETE = re.compile(r"option \S+ is missing")
#: Flags of programs that are neither ours nor among those that `programs` knows.
_FOREIGN = {"--dataset.fps": "lerobot-record"}


def pages() -> dict[str, Page]:
    """Every page with commands that somebody may type."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    for folder in ("docs", "dataset_cards", "plugins", "pretrained"):
        found += sorted((ROOT / folder).rglob("*.md"))
    names = {str(path.relative_to(ROOT)): path for path in found}
    return {name: read_page(path, name) for name, path in names.items() if name not in _SKIPPED}


_PATH = re.compile(
    r"`((?:egovcp|collect|train|deploy|experiment|plugins|tests|benchmarks)/[\w./-]+)`"
)


def test_paths_in_the_repository_exist() -> None:
    missing = [
        f"{name}: {path}"
        for name in PAGES
        for path in _PATH.findall((ROOT / name).read_text(encoding="utf-8"))
        if not (ROOT / path).exists()
    ]
    assert not missing


PAGES = pages()
COMMANDS = [command for page in PAGES.values() for command in commands(page)]


def complete(argv: Sequence[str]) -> list[str]:
    """With names for placeholders, and without the dots that stand for more arguments."""
    filled = []
    for arg in argv:
        for placeholder, name in _PLACEHOLDERS.items():
            arg = re.sub(rf"(?<!\w){placeholder}(?!\w)", name, arg)
        filled.append(arg)
    return [arg for arg in filled if arg != "..."]


def refusal(command: DocumentedCommand) -> str:
    """Why the program refuses the command; empty if it does not."""
    argv = complete(command.argv)
    try:
        check(argv)
    except WrongCommand as error:
        if not (command.inline and _INCOMPLETE.search(str(error))):
            return f"{command}\n    {error}"
    return ""


def is_result(command: DocumentedCommand) -> bool:
    """Whether a report lists the command among hundreds that differ in few values."""
    return command.place.startswith("docs/results/")


@pytest.mark.parametrize("page", [name for name in PAGES if not name.startswith("docs/results/")])
def test_programs_accept_the_commands_of_a_page(
    page: str, prepared: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(prepared)
    mentions = {command.argv: command for command in commands(PAGES[page])}
    problems = [refusal(command) for command in mentions.values()]
    assert not [problem for problem in problems if problem]


def test_programs_accept_the_commands_of_reports() -> None:
    """A command is left out if each of its arguments has been in another of the same program."""
    seen: set[tuple[str, str]] = set()
    problems = []
    for command in filter(is_result, COMMANDS):
        program, *args = command.argv
        values = {(program, re.sub(r"=\S*/\S*", "=PATH", arg)) for arg in args}
        if not values <= seen:
            problems.append(refusal(command))
        seen |= values
    assert not [problem for problem in problems if problem]


def test_flags_in_sentences_exist() -> None:
    """A code span that begins with a flag names one of some command of ours, or its group."""
    texts = [span for page in PAGES.values() for span in page.spans if span.body.startswith("--")]
    problems = []
    for text in texts:
        words = [word for word in shlex.split(text.body) if word.startswith("--")]
        for word in words:
            flag = word.partition("=")[0].removesuffix("*").removesuffix(".")
            known = any(f == flag or f.startswith(f"{flag}.") for f in known_flags())
            if not known and flag not in _FOREIGN:
                problems.append(f"{text.place}: {word}")
    assert not problems


def test_a_block_is_expanded_as_a_shell_does() -> None:
    block = (
        'flags="--a=[1,2] --b"\n'
        "egovcp-train $flags \\\n  --c='{x: 1}'  # a comment\n"
        "for task in ball wall; do egovcp-eval --task=$task; done\n"
        "X=1 egovcp-deploy | head -1"
    )
    found = [command.argv for command in expanded(Text("place", block), inline=False)]
    assert found[:3] == [
        ("egovcp-train", "--a=[1,2]", "--b", "--c={x: 1}"),
        ("egovcp-eval", "--task=ball"),
        ("egovcp-eval", "--task=wall"),
    ]
    # The two ends of a pipe start at the same time, in either order.
    assert sorted(found[3:]) == [("egovcp-deploy",), ("head", "-1")]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("egovcp-train --dataset.rot=data --output_dir=run", "unknown option --dataset.rot"),
        ("egovcp-train --steps=many --output_dir=run", "--steps=many: expected int"),
        ("egovcp-dataset chek data", "unknown subcommand 'chek'"),
        ("egovcp-trian --help", "no program egovcp-trian"),
        ("lerobot-train --policy.typo=egovcp", "policy.typo"),
        ("make coffee", "no target coffee"),
        ("pip install egovcp-train[gpu]", "egovcp-train has no extra gpu"),
        ("python benchmarks/tick.py --part logging --rounds x", "invalid int value"),
    ],
)
def test_a_wrong_command_would_be_found(line: str, message: str) -> None:
    with pytest.raises(WrongCommand, match=re.escape(message)):
        check(shlex.split(line))
