"""Configuration of the simulated robot, and identity of episodes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
import pytest

from egovcp.bounds import Bounds, bounds_of
from egovcp.cli import parse_config
from egovcp.errors import UsageError
from egovcp.sim.config import EnvConfig
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks import task_names
from egovcp.sim.tasks.ball import BallConfig

TASKS = task_names(training=True)


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
    assert len(options) > 60
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


def test_an_event_that_may_come_after_the_end_is_refused() -> None:
    message = r"--env\.wall_episode\.event_ticks=\[20, 60\]: expected less than ticks=15"
    with pytest.raises(UsageError, match=message):
        parse_config(Command, ["--env.wall_episode.ticks=15"], "test")


def draw(scenario: Scenario, name: str) -> list[float]:
    return scenario.rng(name).random(4).tolist()


def test_equal_scenarios_draw_equal_numbers() -> None:
    assert draw(Scenario("ball", 3, 5), "x") == draw(Scenario("ball", 3, 5), "x")


@pytest.mark.parametrize(
    "other", [Scenario("wall", 3, 5), Scenario("ball", 4, 5), Scenario("ball", 3, 6)]
)
def test_any_other_scenario_draws_other_numbers(other: Scenario) -> None:
    assert not np.isin(draw(other, "x"), draw(Scenario("ball", 3, 5), "x")).any()


def test_scenarios_that_data_and_results_exist_of_draw_what_they_always_drew() -> None:
    drawn = [Scenario(task, 3, 5).rng("geometry").integers(10**6) for task in TASKS]
    assert drawn == [752199, 214740, 172848]


def test_streams_of_different_names_differ() -> None:
    scenario = Scenario("ball", 3, 5)
    assert not np.isin(draw(scenario, "x"), draw(scenario, "y")).any()


def test_unknown_task_error_suggests_the_nearest_name() -> None:
    with pytest.raises(UsageError, match="did you mean 'ball'"):
        Scenario("bal", 0, 0)


def test_negative_numbers_are_refused() -> None:
    with pytest.raises(UsageError, match="count from 0"):
        Scenario("ball", -1, 0)
