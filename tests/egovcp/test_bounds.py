"""What numbers an option may be: how it is declared, said, and held against values."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import pytest

from egovcp.bounds import Bounds, OutOfBounds, bounded, check_bounds
from egovcp.cli import parse_config
from egovcp.errors import UsageError


@dataclass(frozen=True)
class Sail:
    """A sail."""

    area: float = bounded(20.0, above=0)
    """Area, m^2."""
    reefs: int | None = bounded(None, least=0, most=3)
    """Reefs; null: as the wind says."""
    trim: float = -0.5
    """Any angle, rad."""


@dataclass(frozen=True)
class Keel:
    """A keel, which checks itself wherever it is made."""

    depth: float = bounded(1.5, above=0)
    """Depth, m."""

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True)
class Boat:
    """A boat."""

    name: str = "none"
    """Its name."""
    afloat: bool = True
    """Afloat."""
    sail: Sail = field(default_factory=Sail)
    """The sail."""
    keel: Keel = field(default_factory=Keel)
    """The keel."""
    wind: tuple[float, float] = bounded((2.0, 8.0), least=0, below=30)
    """Weakest and strongest, m/s."""
    crew: dict[str, int] = bounded({}, least=1)
    """Watch -> hands."""
    spare: tuple[Sail, ...] = ()
    """Further sails."""


def test_integers_are_exact() -> None:
    assert str(Bounds(least=1e-4, most=2**20)) == "at least 0.0001 and at most 1048576"


def _parse(*argv: str) -> Boat:
    return parse_config(Boat, argv, "egovcp-test")


def test_defaults_are_what_they_were_without_bounds() -> None:
    assert Boat() == _parse()
    assert (Boat().sail.area, Boat.wind, Boat().sail.reefs) == (20.0, (2.0, 8.0), None)
    assert Boat().crew is not Boat().crew


@pytest.mark.parametrize(
    "flag",
    [
        "--sail.area=0.001",
        "--sail.reefs=3",
        "--sail.reefs=0",
        "--sail.reefs=null",
        "--sail.trim=-3",
        "--wind=[0,29.9]",
        "--crew={dog: 1}",
        "--spare=[{area: 3}]",
    ],
)
def test_values_within_bounds_are_accepted(flag: str) -> None:
    _parse(flag)


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--sail.area=0", "--sail.area=0.0: expected more than 0"),
        ("--sail.area=.inf", "--sail.area=inf: expected a finite number"),
        ("--sail.reefs=4", "--sail.reefs=4: expected at least 0 and at most 3"),
        ("--sail.trim=.nan", "--sail.trim=nan: expected a finite number"),
        ("--keel.depth=-1", "--keel.depth=-1.0: expected more than 0"),
        ("--wind=[1,30]", "--wind=[1.0, 30.0]: expected at least 0 and less than 30"),
        ("--crew={dog: 2, first: 0}", "--crew={dog: 2, first: 0}: expected at least 1"),
        ("--spare=[{}, {area: -2}]", "--spare[1].area=-2.0: expected more than 0"),
    ],
)
def test_values_out_of_bounds_are_refused_with_their_flag(flag: str, message: str) -> None:
    """Whether the command checks it or the config itself."""
    with pytest.raises(UsageError) as caught:
        _parse(flag)
    assert str(caught.value) == message


def test_a_config_that_checks_itself_needs_no_command_line() -> None:
    with pytest.raises(OutOfBounds, match=r"^depth=0: expected more than 0$"):
        Keel(depth=0)


def test_a_command_whose_whole_config_checks_itself_names_the_flag_too() -> None:
    with pytest.raises(UsageError, match=r"^--depth=-1\.0: expected more than 0$"):
        parse_config(Keel, ["--depth=-1"], "egovcp-test")


def test_help_shows_the_bounds(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        _parse("--help=all")
    words = " ".join(capsys.readouterr().out.split())
    assert "Area, m^2. [more than 0] (default: 20.0)" in words
    assert "Reefs; null: as the wind says. [at least 0 and at most 3]" in words
    assert "Any angle, rad. (default: -0.5)" in words


@pytest.mark.parametrize(
    ("bounds", "inside", "outside"),
    [
        (Bounds(least=1), (1, 2.5), (0.999, math.nan, math.inf)),
        (Bounds(most=1), (1, -7), (1.001, -math.inf)),
        (Bounds(above=0, below=1), (0.5,), (0, 1)),
        (Bounds(), (-3, 0, 1e300), (math.nan, math.inf)),
    ],
)
def test_ends_are_open_or_not(
    bounds: Bounds, inside: tuple[float, ...], outside: tuple[float, ...]
) -> None:
    assert all(map(bounds.contains, inside))
    assert not any(map(bounds.contains, outside))
