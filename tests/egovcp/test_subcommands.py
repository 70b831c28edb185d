"""Commands with subcommands: dispatch, help and arguments without a flag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest

from egovcp.dataset_options import DatasetConfig
from egovcp.errors import DataError
from egovcp.subcommands import CommandGroup, Subcommand

calls: list[Any] = []


@dataclass(frozen=True)
class CopyConfig:
    """Copy a thing."""

    source: str = ""
    """What to copy."""
    target: str = ""
    """Where to."""
    others: list[str] = field(default_factory=list)
    """More things."""
    fast: bool = False
    """Whether to hurry."""
    mode: Literal["hard", "soft"] = "hard"
    """How."""


@dataclass(frozen=True)
class ShowConfig:
    """Show a dataset."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The dataset."""


def copy(config: CopyConfig) -> None:
    calls.append(config)


def show(config: ShowConfig, argv: Sequence[str]) -> None:
    calls.append((config.dataset, list(argv)))


def fail(config: ShowConfig) -> None:
    raise DataError("bad data")


GROUP = CommandGroup(
    "egovcp-test",
    "Does things.",
    {
        "copy": Subcommand(f"{__name__}:copy", "copy things", ("source", "target"), "others"),
        "show": Subcommand(f"{__name__}:show", "show one", ("dataset",), takes_argv=True),
        "fail": Subcommand(f"{__name__}:fail", "fail", defaults=lambda args: {}),
    },
)


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, __name__, type(sys)(__name__))
    vars(sys.modules[__name__]).update(globals())
    calls.clear()


@pytest.mark.parametrize(
    ("argv", "config"),
    [
        (["a", "b"], CopyConfig("a", "b")),
        (["a", "b", "c", "d"], CopyConfig("a", "b", ["c", "d"])),
        (["--mode", "soft", "a", "--fast", "b"], CopyConfig("a", "b", fast=True, mode="soft")),
        (["--target=b", "a"], CopyConfig("a", "b")),
        (["--target", "-", "a"], CopyConfig("a", "-")),
    ],
)
def test_arguments_without_a_flag_stand_for_options(argv: list[str], config: CopyConfig) -> None:
    assert GROUP.main(["copy", *argv]) == 0
    assert calls == [config]


def test_a_dataset_is_a_folder_or_an_id_and_the_command_line_is_passed_on() -> None:
    for place, dataset in (
        (".", DatasetConfig(root=".")),
        ("user/name", DatasetConfig(repo_id="user/name")),
    ):
        calls.clear()
        assert GROUP.main(["show", place]) == 0
        assert calls == [(dataset, ["egovcp-test", "show", place])]


@pytest.mark.parametrize(
    ("argv", "code", "message"),
    [
        ([], 2, ""),
        (["cpoy"], 2, "egovcp-test: error: unknown subcommand 'cpoy'; did you mean 'copy'?"),
        (["show", "a", "b"], 2, "unexpected argument 'b'; usage: egovcp-test show DATASET"),
        (["copy", "--moed=soft"], 2, "did you mean '--mode'?; see egovcp-test copy --help"),
        (["fail"], 3, "egovcp-test fail: error: bad data"),
    ],
)
def test_errors_have_the_exit_code_of_their_kind(
    argv: list[str], code: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert GROUP.main(argv) == code
    assert message in capsys.readouterr().err
    assert not calls


def test_help_lists_the_subcommands_and_all_options_on_request(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert GROUP.main(["--help"]) == 0
    brief = capsys.readouterr().out
    assert "  copy SOURCE TARGET OTHERS...  copy things\n" in brief
    assert "--mode" not in brief
    assert GROUP.main(["--help=all"]) == 0
    full = capsys.readouterr().out
    assert full.startswith(brief)
    assert full.count("--dataset.root") == 1  # `show` and `fail` have the same options
    assert "egovcp-test show, fail\n" in full
    assert GROUP.main(["--help=flags"]) == 0
    flags = capsys.readouterr().out.splitlines()
    assert {"copy --mode hard soft", "copy --fast true false", "show --dataset.root"} <= set(flags)


@pytest.mark.parametrize("topic", ["--help", "--help=all", "--help=dataset"])
def test_a_subcommand_has_its_own_help(topic: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        GROUP.main(["show", topic])
    assert end.value.code == 0
    assert "--dataset.repo_id" in capsys.readouterr().out
