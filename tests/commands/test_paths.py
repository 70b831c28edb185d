"""Every option that takes a file or a folder, given something else: refused before work starts."""

from __future__ import annotations

import json
import os
import re
import traceback
from collections import Counter
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import pytest

from egovcp.artifact import load_artifact, save_artifact
from egovcp.data import DatasetWriter, Provenance
from egovcp.flags import flags_of
from egovcp.log.mcap import McapSink
from egovcp.log.tick import RunInfo
from egovcp.plan import PlannerConfig
from egovcp.robot.stance import StanceController
from egovcp.rollouts import CONTROLLER, ticks_of
from egovcp.testing import random_episode, toy_model
from tests.support.limited import LimitedResult, run_limited

from .listing import ListedCommand, all_commands

SECONDS = 30.0  # limit for all values of a command
STANCE = "--env.controller=stance"
#: Before and after the output of a command.
_BEGIN, _END = "=== begin\n", "=== end "
#: `ListedCommand.prog` -> (its arguments, options that name an input, options that name an output).
CASES = {
    "egovcp-collect": (
        f"--dataset.root=NEW --episodes=1 --num_workers=1 {STANCE}",
        ("env.controller", "config_path"),
        ("dataset.root",),
    ),
    "egovcp-dataset info": ("DATA", ("dataset.root",), ("json",)),
    "egovcp-dataset check": ("DATA", ("dataset.root",), ("json",)),
    "egovcp-dataset repair": (
        "DATA --output_dir=NEW",
        ("dataset.root", "records"),
        ("output_dir", "json"),
    ),
    "egovcp-dataset delete": (
        "DATA --episodes=[1] --output_dir=NEW",
        ("dataset.root",),
        ("output_dir", "json"),
    ),
    "egovcp-dataset split": (
        'DATA --splits={"a":1} --output_dir=NEW',
        ("dataset.root",),
        ("output_dir", "json"),
    ),
    "egovcp-dataset merge": (
        "DATA DATA --duplicates=drop --output_dir=NEW",
        ("dataset.root", "others"),
        ("output_dir", "json"),
    ),
    "egovcp-dataset coverage": ("DATA", ("dataset.root",), ("output_dir", "json")),
    "egovcp-dataset card": ("DATA --output=NEW", ("dataset.root",), ("output",)),
    "egovcp-dataset viz": ("DATA --output=NEW", ("dataset.root",), ("output",)),
    "egovcp-dataset push": ("DATA --repo_id=me/data", ("dataset.root",), ()),
    "egovcp-dataset pull": ("me/data --output_dir=NEW", (), ("output_dir",)),
    "egovcp-train": (
        "--dataset.root=DATA --output_dir=NEW --preset=debug --steps=2 --batch_size=2",
        ("dataset.root", "config_path"),
        ("output_dir",),
    ),
    "egovcp-info": ("", (), ("json",)),
    "egovcp-push": ("--policy.path=POLICY --repo_id=me/policy", ("policy.path",), ()),
    "egovcp-export": ("--policy.path=POLICY --output_dir=NEW", ("policy.path",), ("output_dir",)),
    "egovcp-eval-model": (
        "--policy.path=POLICY --dataset.root=DATA --output_dir=NEW",
        ("policy.path", "dataset.root"),
        ("output_dir",),
    ),
    "egovcp-train-lowlevel": ("--output_dir=NEW --steps=10", (), ("output_dir",)),
    "egovcp-eval-lowlevel": (
        "--controller=stance --episodes=1 --output_dir=NEW",
        ("controller",),
        ("output_dir",),
    ),
    "egovcp-train-ppo": (
        f"--output_dir=NEW --steps=10 {STANCE}",
        ("env.controller",),
        ("output_dir",),
    ),
    "egovcp-deploy": (
        f"--policy.path=POLICY --output_dir=NEW --episodes=1 {STANCE}",
        ("policy.path", "env.controller"),
        ("output_dir",),
    ),
    "egovcp-demo": (
        f"--policy.path=POLICY --task=ball --output_dir=NEW {STANCE}",
        ("policy.path", "env.controller"),
        ("output_dir",),
    ),
    "egovcp-eval": (
        f"--policy.path=POLICY --output_dir=NEW --episodes=1 {STANCE}",
        ("policy.path", "env.controller"),
        ("output_dir",),
    ),
    "egovcp-compare": ("--run=NEW --other=NEW", ("run", "other"), ()),
    "egovcp-fake-g1": (STANCE, ("env.controller",), ("json",)),
    "egovcp-task list": ("", (), ()),
    "egovcp-task check": ("ball --episodes=1", ("env.controller",), ("json",)),
    "egovcp-task play": (f"ball --output_dir=NEW {STANCE}", ("env.controller",), ("output_dir",)),
    "egovcp-task new": ("reach --output_dir=NEW", (), ("output_dir",)),
    "egovcp-mcap info": ("RECORDING", ("file",), ("json",)),
    "egovcp-mcap recover": ("RECORDING NEW", ("file",), ("output",)),
    "egovcp-mcap to-dataset": ("RECORDING --dataset.root=NEW", ("files",), ("dataset.root",)),
    "egovcp-experiment ablations": (
        "--output_dir=NEW --scale=smoke --tasks=[ball] --only=[default]",
        ("data.roots", "train.policies"),
        ("output_dir",),
    ),
}
#: The same of commands that take further paths, depending on other options.
MORE = (
    ("egovcp-mcap to-dataset", "RECORDING --dataset.root=NEW", ("mapping",), ()),
    (
        "egovcp-deploy",
        f"--policy.path=POLICY --output_dir=NEW --robot.type=replay {STANCE}",
        ("robot.recordings",),
        (),
    ),
    (
        "egovcp-eval",
        f"--output_dir=NEW --episodes=1 --controllers=constant {STANCE}",
        ("constant.path",),
        (),
    ),
    (
        "egovcp-eval",
        f"--output_dir=NEW --episodes=1 --controllers=ppo {STANCE}",
        ("ppo.path",),
        (),
    ),
)
INPUTS = (
    *("absent", "fifo", "dangling", "loop", "empty", "folder", "empty/below", "/dev/null"),
    *("x" * 300, "y/" * 3000, "\x1b[31m", "\udcff", "~nobody/x", "", "recording.mcap"),
)
#: (option, value) pairs that are valid, and therefore left out.
VALID = {
    *(("file", "recording.mcap"), ("files", "recording.mcap"), ("config_path", "empty")),
    *(("records", ""), ("train.policies", "empty/below"), ("robot.recordings", "recording.mcap")),
    *(("constant.path", ""), ("mapping", "")),
}
OUTPUTS = ("loop", "empty/below", "x" * 300, "/proc/new", "/dev/null/new", "\udcff", "a\0b", "fifo")


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a dataset, a policy, a recording, and what is none of them."""
    folder = tmp_path_factory.mktemp("places")
    provenance = Provenance(StanceController().id, seed=0, command="collect")
    with DatasetWriter(folder / "data", provenance) as writer:
        for number in range(3):
            writer.add(random_episode(number, length=30))
    planner = PlannerConfig(samples=16, horizon=3, iterations=2, elites=4, eta=0.02)
    save_artifact(folder / "policy", toy_model(), planner, {"controller_id": StanceController().id})
    load_artifact(str(folder / "policy"))  # imports what the forked commands would each import
    sink = McapSink(folder / "recording.mcap")
    sink.open(RunInfo("ball", seed=3, episode=7, hashes={CONTROLLER: StanceController().id}))
    for tick in ticks_of(random_episode(0, length=8)):
        sink.write(tick)
    sink.close()
    os.mkfifo(folder / "fifo")
    (folder / "dangling").symlink_to("nowhere")
    (folder / "loop").symlink_to("loop")
    (folder / "empty").touch()
    (folder / "folder").mkdir()
    return folder


def test_every_command_is_listed() -> None:
    without = {"egovcp-depth-server"}
    assert {c.prog for c in all_commands()} == CASES.keys() | without


type BadFlags = list[tuple[str, str]]


def _cases() -> Iterator[tuple[str, str, BadFlags]]:
    """(program, its arguments, flags with bad paths).

    The first command with an option gets all values; later ones, which share the parsing code, get
    a rotating quarter (inputs) or third (outputs).
    """
    commands = Counter[tuple[str, tuple[str, ...]]]()
    for prog, arguments, inputs, outputs in [*((p, *case) for p, case in CASES.items()), *MORE]:
        bad: BadFlags = []
        for options, values, share in ((inputs, INPUTS, 4), (outputs, OUTPUTS, 3)):
            for option in options:
                earlier = commands[option, values]
                commands[option, values] += 1
                chosen = values[earlier % share :: share] if earlier else values
                bad += [(option, value) for value in chosen if (option, value) not in VALID]
        yield prog, arguments, bad


@pytest.mark.parametrize(("prog", "arguments", "bad"), _cases())
def test_a_bad_path_is_refused_before_work_starts(
    prog: str,
    arguments: str,
    bad: BadFlags,
    places: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(places)
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    command = next(c for c in all_commands() if c.prog == prog)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)  # read at its import
    flags = list(map(_flag, bad))
    given = [*command.arguments, *_arguments(arguments)]
    # one child for all values: a fork takes longer than most commands
    found = run_limited(lambda: _try_all(command, given, flags, places), SECONDS)
    problems = []
    for (flag, value), text in zip_longest(flags, found.output.split(_BEGIN)[1:], fillvalue=""):
        if problem := _problem(command, flag, text, found):
            problems.append(f"{prog} {flag}={value[:60]!a}: {problem}")
    assert not problems, "\n".join(problems)


def _try_all(
    command: ListedCommand, given: list[str], flags: list[tuple[str, str]], folder: Path
) -> int:
    """Run a command with each of the flags; print what it prints, its exit code, and the files it
    leaves behind, which are removed."""
    before = _contents(folder)
    for flag, value in flags:
        print(_BEGIN, end="")
        try:
            code = command.main([*given, f"{flag}={value}"])
        except BaseException:  # noqa: BLE001 - a traceback is a problem, whatever it is of
            traceback.print_exc()
            code = -1
        created = _contents(folder) - before
        for name in sorted(created, reverse=True):  # the next case starts as this one did
            path = folder / name
            path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
        print(f"{_END}{json.dumps([code, sorted(created)])}")
    return 0


def _arguments(text: str) -> list[str]:
    names = {"DATA": "data", "POLICY": "policy", "RECORDING": "recording.mcap"}
    for name, path in names.items():
        text = text.replace(name, path)
    return text.replace("NEW", "new").split()


def _flag(option_and_value: tuple[str, str]) -> tuple[str, str]:
    """The flag of an option, and its value as a command line has it."""
    option, value = option_and_value
    if option in ("others", "files"):
        value = f'["{value}"]'
    elif option in ("data.roots", "train.policies"):
        value = f'{{ball: "{value}"}}'
    return f"--{option}", value


def _problem(command: ListedCommand, flag: str, text: str, found: LimitedResult) -> str:
    printed, _, end = text.partition(_END)
    output = printed.replace("\n", "\\n")[-600:]
    if not end:
        why = f"took more than {SECONDS} s" if found.timed_out else f"ended {found.exit_code}"
        return f"{why}: {output}"
    exit_code, created = json.loads(end)
    if "Traceback (most recent call last)" in printed or not 2 <= exit_code <= 5:
        return f"exit code {exit_code}: {output}"
    if created:
        return f"created {created}"
    errors = [line for line in printed.splitlines() if ": error: " in line]
    if len(errors) != 1 or not errors[0].isprintable():
        return f"expected one line: {output}"
    named = {f for f in re.findall(r"(?<![\w.-])--[a-z][\w.]*", errors[0]) if "`" not in errors[0]}
    known = {*flags_of(command.config_class), "--help", "--debug"}
    if strange := {f for f in named if f.rstrip(".") not in known}:
        return f"names {strange}: {output}"
    return ""


def _contents(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}
