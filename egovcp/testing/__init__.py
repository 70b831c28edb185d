"""Toy worlds and counting fakes that prove time, resets and actions line up; a fake Hub.

For tests of egovcp and of anything built on it. Each fake makes one thing visible that a
real network hides: which action led where, how many ticks have passed since a reset. The
Hub, `egovcp.testing.hub`, fails on demand.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from egovcp.testing.batches import memory_batch, random_batch
    from egovcp.testing.environments import CountingEnv, ToyObservation, ToyStep
    from egovcp.testing.episodes import random_episode
    from egovcp.testing.models import CountingModel, toy_model, toy_reactive
    from egovcp.testing.planning import Point, PointWorld, ScriptedWorld, plain_planner
    from egovcp.testing.recordings import AgainRecorder

__all__ = [
    "AgainRecorder",
    "CountingEnv",
    "CountingModel",
    "Point",
    "PointWorld",
    "ScriptedWorld",
    "ToyObservation",
    "ToyStep",
    "memory_batch",
    "plain_planner",
    "random_batch",
    "random_episode",
    "toy_model",
    "toy_reactive",
]

_HOME = {
    "memory_batch": "batches",
    "random_batch": "batches",
    "CountingEnv": "environments",
    "ToyObservation": "environments",
    "ToyStep": "environments",
    "random_episode": "episodes",
    "CountingModel": "models",
    "toy_model": "models",
    "toy_reactive": "models",
    "Point": "planning",
    "PointWorld": "planning",
    "ScriptedWorld": "planning",
    "plain_planner": "planning",
    "AgainRecorder": "recordings",
}


def __getattr__(name: str) -> Any:
    """Import a fake when it is asked for: the Hub needs neither torch nor numpy."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
