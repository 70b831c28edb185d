"""Commands refuse the options that they had in older versions."""

import pytest

from egovcp.flags import options_of
from egovcp.removed_options import REMOVED_OPTIONS, RENAMED_OPTIONS

from .listing import all_commands


def test_no_option_of_a_command_is_listed_as_removed() -> None:
    flags = {flag for command in all_commands() for flag in options_of(command.config_class)}
    assert not {f"--{name}" for name in (*REMOVED_OPTIONS, *RENAMED_OPTIONS)} & flags
    assert {f"--{name}" for name in RENAMED_OPTIONS.values()} <= flags


@pytest.mark.parametrize(
    ("prog", "flag", "remedy"),
    [
        ("egovcp-train", "--value_fit.steps=0", "leave it out"),
        ("egovcp-train", "--policy.flight.enabled=false", "leave it out"),
        ("egovcp-train", "--datasets=[{root: x, return_steps: 9}]", "--returns.steps"),
        ("egovcp-train", "--planner.ensemble=min", "leave it out"),
        ("egovcp-eval", "--planner.ensemble=min", "leave it out"),
        ("egovcp-eval", "--planner.process=ramp", "planner.action_parameterization"),
        ("egovcp-train", "--policy.loss.near=0", "policy.loss.proximity_weight"),
        ("egovcp-train", "--policy.loss.depth=1", "--config_path"),
        ("egovcp-train", "--planner={latent: sample}", "--config_path"),
        ("egovcp-eval", "--env.wall.guard_cost=0", "leave it out"),
        ("egovcp-eval", "--env.arch.motion=rail", "use a controller that walks"),
        ("egovcp-eval", "--env.arch.head_cost=1", "--env.arch.hit_cost"),
        ("egovcp-train-ppo", "--env.ball.pose_cost=0", "--env.pose_cost"),
        ("egovcp-eval-model", "--return_steps=16", "leave it out"),
        ("egovcp-collect", "--backend=ray", "leave it out"),
        ("egovcp-dataset card", "--assets=plots", "leave it out"),
        ("egovcp-export", "--format=float16", "half precision only"),
        ("egovcp-deploy", "--realtime=true", "egovcp-fake-g1"),
    ],
)
def test_command_refuses_a_removed_option_in_one_line(
    prog: str, flag: str, remedy: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (command,) = (c for c in all_commands() if c.prog == prog)
    assert command.main([*command.arguments, flag, "--output_dir=x"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{prog}: error: option --")
    assert any(text in line for text in (" was removed", " was renamed", " is not a flag"))
    assert remedy in line
