"""Options of older versions are refused with the reason and what replaces them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import pytest

from egovcp.cli import parse_config
from egovcp.errors import UsageError
from egovcp.removed_options import PROGRAMS, REMOVED_OPTIONS, RENAMED_OPTIONS


@dataclass(frozen=True)
class Dataset:
    """A dataset."""

    root: str = ""
    """Folder."""


@dataclass(frozen=True)
class Loss:
    """Losses."""

    value: float = 20.0
    """Weight of Q."""


@dataclass(frozen=True)
class Policy:
    """A policy."""

    units: int = 256
    """Width."""
    loss: Loss = field(default_factory=Loss)
    """Losses."""


@dataclass(frozen=True)
class Config:
    """A command for tests."""

    policy: Policy = field(default_factory=Policy)
    """Its policy."""
    datasets: tuple[Dataset, ...] = ()
    """Its data."""


def _error(*argv: str, prog: str = "egovcp-test") -> str:
    with pytest.raises(UsageError) as caught:
        parse_config(Config, argv, prog)
    return str(caught.value)


@pytest.mark.parametrize("name", REMOVED_OPTIONS)
def test_removed_flag_is_refused_with_its_reason(name: str) -> None:
    (prog, *_) = PROGRAMS.get(name, ("egovcp-test",))
    error = _error(f"--{name}=1", prog=prog)
    assert error == f"option --{name} was removed: {REMOVED_OPTIONS[name]}"


@pytest.mark.parametrize("name", PROGRAMS)
def test_flag_that_another_program_had_is_unknown(name: str) -> None:
    assert f"unknown option --{name}" in _error(f"--{name}=1")


@pytest.mark.parametrize(("old", "new"), RENAMED_OPTIONS.items())
def test_renamed_flag_is_refused_with_its_new_name(old: str, new: str) -> None:
    error = _error(f"--{old}=1")
    assert error.startswith(f"option --{old} was renamed to {new}")
    assert ("--config_path" in error) == new.startswith("policy.loss.")


def test_flag_within_a_removed_group_is_refused_with_the_reason_of_the_group() -> None:
    expected = f"option --value_fit.steps was removed: {REMOVED_OPTIONS['value_fit']}"
    assert _error("--value_fit.steps=0") == expected
    assert _error("--value_fit.steps", "0") == expected


def test_removed_key_of_a_group_or_of_a_list_item_is_refused() -> None:
    assert _error("--policy.loss={motion: 1}").startswith("option --policy.loss.motion was removed")
    assert _error("--datasets=[{root: a}, {root: b, return_steps: 9}]") == (
        "option --datasets[1].return_steps was removed: " + REMOVED_OPTIONS["datasets.return_steps"]
    )


@pytest.mark.parametrize(
    "flag", ["--value_fits=0", "--policy.flights=1", "--policy.loss.x.motion=1"]
)
def test_flag_that_only_resembles_a_removed_one_is_unknown(flag: str) -> None:
    assert f"unknown option {flag.partition('=')[0]}" in _error(flag)


@pytest.mark.parametrize(
    ("content", "name"),
    [
        ("policy: {units: 64, flight: {enabled: true}}\n", "policy.flight"),
        ("datasets: [{root: a}, {root: b, return_steps: null}]\n", "datasets[1].return_steps"),
    ],
)
def test_config_file_with_a_removed_option_is_refused(
    content: str, name: str, tmp_path: Path
) -> None:
    file = tmp_path / "old.yaml"
    file.write_text(content)
    assert _error(f"--config_path={file}").startswith(f"option --{name} was removed: ")


# --- options that are not flags ------------------------------------------------------


@dataclass(frozen=True)
class LimitedConfig:
    """A command with fewer flags than options."""

    cli_options: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "": ("policy",),
        "policy": ("units", "loss"),
        "policy.loss": (),
    }
    policy: Policy = field(default_factory=Policy)
    """Its policy."""
    steps: int = 3
    """Not a flag."""


@pytest.mark.parametrize(
    ("argument", "option"),
    [
        ("--policy.loss.value=1", "--policy.loss.value"),
        ("--policy.loss={value: 1}", "--policy.loss.value"),
        ("--policy={loss: {value: 1}}", "--policy.loss.value"),
        ("--steps=1", "--steps"),
    ],
)
def test_option_that_is_not_a_flag_is_refused_on_the_command_line(
    argument: str, option: str
) -> None:
    with pytest.raises(UsageError, match=f"option {option} is not a flag"):
        parse_config(LimitedConfig, [argument], "egovcp-test")


def test_option_that_is_not_a_flag_is_read_from_a_config_file(tmp_path: Path) -> None:
    file = tmp_path / "options.yaml"
    file.write_text("steps: 5\npolicy: {loss: {value: 1}}\n")
    argv = [f"--config_path={file}", "--policy.units=64"]
    config = parse_config(LimitedConfig, argv, "egovcp-test")
    assert config == LimitedConfig(Policy(64, Loss(1.0)), steps=5)


def test_help_and_suggestions_leave_out_options_that_are_not_flags(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        parse_config(LimitedConfig, ["--help"], "egovcp-test")
    text = capsys.readouterr().out
    assert "--policy.units" in text
    assert "--steps" not in text
    assert "--policy.loss.value" not in text
    with pytest.raises(UsageError) as caught:
        parse_config(LimitedConfig, ["--step=1"], "egovcp-test")
    assert "--steps" not in str(caught.value)
