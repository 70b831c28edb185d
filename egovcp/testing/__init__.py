"""Toy worlds and counting fakes that prove time, resets and actions line up; a fake Hub.

For tests of egovcp and of anything built on it. Each fake makes one thing visible that a
real network hides: which action led where, how many ticks have passed since a reset. The
Hub, `egovcp.testing.hub`, fails on demand.
"""

from egovcp.testing.batches import memory_batch, random_batch
from egovcp.testing.environments import CountingEnv, ToyObservation, ToyStep
from egovcp.testing.episodes import random_episode
from egovcp.testing.models import CountingModel, toy_model
from egovcp.testing.planning import Point, PointWorld, ScriptedWorld

__all__ = [
    "CountingEnv",
    "CountingModel",
    "Point",
    "PointWorld",
    "ScriptedWorld",
    "ToyObservation",
    "ToyStep",
    "memory_batch",
    "random_batch",
    "random_episode",
    "toy_model",
]
