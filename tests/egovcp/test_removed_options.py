"""Options of older versions are refused with the reason and what replaces them."""

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from egovcp.cli import parse_config
from egovcp.errors import UsageError
from egovcp.removed_options import REMOVED_OPTIONS


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


def _error(*argv: str) -> str:
    with pytest.raises(UsageError) as caught:
        parse_config(Config, argv, "egovcp-test")
    return str(caught.value)


@pytest.mark.parametrize("name", REMOVED_OPTIONS)
def test_removed_flag_is_refused_with_its_reason(name: str) -> None:
    assert _error(f"--{name}=1") == f"option --{name} was removed: {REMOVED_OPTIONS[name]}"


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


def test_config_file_is_refused_with_all_its_removed_options(tmp_path: Path) -> None:
    file = tmp_path / "old.yaml"
    file.write_text(
        "value_fit: {steps: 0}\n"
        "passing: {horizon: 3}\n"
        "policy: {units: 64, flight: {enabled: true}, loss: {value: 1, motion: 2}}\n"
        "datasets: [{root: a, return_steps: null}]\n"
    )
    tracker, fit = REMOVED_OPTIONS["passing"], REMOVED_OPTIONS["value_fit"]
    steps = REMOVED_OPTIONS["datasets.return_steps"]
    assert _error(f"--config_path={file}") == (
        f"--config_path={file} has options that were removed: value_fit ({fit}); "
        f"passing, policy.flight, policy.loss.motion ({tracker}); "
        f"datasets[0].return_steps ({steps})"
    )
