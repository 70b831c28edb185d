"""How many robots this machine can simulate side by side."""

from __future__ import annotations

from typing import Final

from egovcp.hardware import require_memory

_ROBOT_BYTES: Final = 900_000
"""Of MuJoCo's state of one robot and its scene; measured, and little of what a robot takes when
its episode is recorded or planned."""


def require_robots(option: str, count: int, robots: int | None = None) -> None:
    """Raise `UsageError` unless there is memory for the state of the robots.

    Args:
        option: the option that says how many, ``--num_envs``.
        count: its value.
        robots: how many there are because of it; None: ``count``.
    """
    require_memory(f"{option}={count}", _ROBOT_BYTES * (count if robots is None else robots))
