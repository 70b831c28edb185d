from __future__ import annotations

from dataclasses import dataclass, field

import pytest

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
