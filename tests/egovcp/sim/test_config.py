from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import pytest

from egovcp.bounds import Bounds, bounds_of
from egovcp.cli import parse_config
from egovcp.errors import UsageError
from egovcp.sim.config import BallConfig, EnvConfig


@dataclass(frozen=True)
class Command:
    """A command with an environment."""

    env: EnvConfig = field(default_factory=EnvConfig)


def test_every_parameter_is_a_dotted_flag() -> None:
    flags = [
        "--env.ball.radius_range=[0.15,0.16]",
        "--env.ball_episode.event_ticks=[2,10]",
        "--env.camera.position=[0.1,0.0,0.4]",
        "--env.feet=stock",
    ]
    env = parse_config(Command, flags, "test").env
    assert env.ball.radius_range == (0.15, 0.16)
    assert env.ball_episode.event_ticks == (2, 10)
    assert env.camera.position == (0.1, 0.0, 0.4)
    assert env.feet == "stock"


def test_parts_of_a_sequence_are_a_flag() -> None:
    env = parse_config(Command, ["--env.sequence.parts=[arch,ball,wall]"], "test").env
    assert env.sequence.parts == ("arch", "ball", "wall")
    assert env.episode("sequence").ticks == 230 + 150 + 150


def test_a_range_the_wrong_way_round_is_refused_by_name() -> None:
    with pytest.raises(UsageError, match=r"0.3 > 0.2 in env.ball.radius_range"):
        EnvConfig(ball=BallConfig(radius_range=(0.3, 0.2)))


def test_an_unknown_task_has_no_episode() -> None:
    with pytest.raises(UsageError, match="choose from: arch, ball, sequence, wall"):
        EnvConfig().episode("stairs")


def _numeric_options(part: Any, prefix: str) -> Iterator[tuple[str, Bounds | None]]:
    for option in fields(part):
        value, name = getattr(part, option.name), f"{prefix}{option.name}"
        if is_dataclass(value):
            yield from _numeric_options(value, f"{name}.")
        elif not isinstance(next(iter(value), "") if isinstance(value, tuple) else value, str):
            yield name, bounds_of(option)


def test_every_number_is_bounded_on_both_sides() -> None:
    options = list(_numeric_options(EnvConfig(), "--env."))
    assert len(options) > 70
    for name, bounds in options:
        assert bounds is not None, name
        limits = (bounds.least, bounds.above), (bounds.most, bounds.below)
        assert all(any(x is not None and math.isfinite(x) for x in side) for side in limits), name


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("ball.radius_range", "[0.1,100]"),
        ("ball.mass_range", "[0.1,1e6]"),
        ("ball.flight_range", "[1e-6,1]"),
        ("wall.push_speed_range", "[0,1000]"),
        ("arch.speed_range", "[0.3,1e5]"),
        ("randomise.mass_scale", "[1e-9,1]"),
        ("randomise.friction", "[0,1]"),
        ("camera.position", "[0,0,1e9]"),
        ("sensors.joint_velocity", "1e9"),
        ("delay.image_age", "[0,1e9]"),
        ("ball_episode.ticks", "1000000000"),
    ],
)
def test_what_cannot_be_simulated_is_refused_by_name(flag: str, value: str) -> None:
    with pytest.raises(UsageError, match=rf"--env\.{flag}=.*: expected at"):
        parse_config(Command, [f"--env.{flag}={value}"], "test")
