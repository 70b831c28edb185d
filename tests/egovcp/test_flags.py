"""Options that are no flags: constants that only a configuration file or Python sets."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import pytest

from egovcp.cli import parse_config
from egovcp.errors import UsageError


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
