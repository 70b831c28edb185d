"""Synthetic ticks: a squatting robot, a flying ball, and everything a log can hold."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egovcp.log.tick import MODES, Candidates, MotorReadings, Tick, ValueMap
from egovcp.spec import STATE_DIM, STATE_SLICES, Solid

MakeTick = Callable[..., Tick]
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.fixture
def make_tick() -> MakeTick:
    """``make_tick(index)`` with everything; ``make_tick(index, bare=True)`` with the least."""
    return _tick


def _tick(index: int, bare: bool = False) -> Tick:
    rng = np.random.default_rng(index)
    state = rng.normal(0, 0.1, STATE_DIM).astype(np.float32)
    state[STATE_SLICES["projected_gravity"]] = (0.0, 0.0, -1.0)
    state[STATE_SLICES["command_height"]] = 0.7
    state[STATE_SLICES["command_hands"]] = (0.3, 0.2, 0.1, 0.3, -0.2, 0.1)
    depth = rng.integers(280, 5000, (48, 64)).astype(np.uint16)
    depth[rng.random((48, 64)) < 0.1] = 0
    action = rng.uniform(-1, 1, (2, 7)).astype(np.float32)
    least = {
        "index": index,
        "time_ns": index * 40_000_000,
        "depth": depth,
        "state": state,
        "action_planned": action[0],
        "action_sent": action[1],
        "reward": 0.25 * index,
    }
    return Tick(**least) if bare else Tick(**least, **_rest(index, rng))


def _rest(index: int, rng: np.random.Generator) -> dict[str, object]:
    ball = np.array([2.0 - 0.1 * index, 0.1, 1.0])
    return {
        "depth_reconstructed": rng.integers(0, 5000, (48, 64)) / 1000.0,
        "depth_imagined": rng.integers(0, 5000, (5, 48, 64)) / 1000.0,
        "plan": rng.uniform(-1, 1, (4, 7)),
        "candidates": Candidates(
            rng.uniform(0, 0.5, (8, 4, 2, 3)).astype(np.float32),
            rng.normal(size=8).astype(np.float32),
        ),
        "value_maps": tuple(_value_map(hand, rng) for hand in ("left", "right")),
        "value": float(rng.normal()),
        "termination": 0.01 * index,
        "reward_terms": {"block": 1.0 * index, "pose": -0.1},
        "success": index > 1,
        "timing_ms": {"filter": 1.5, "plan": 12.0},
        "base": np.array([0.01 * index, 0.0, 0.7, 1.0, 0.0, 0.0, 0.0]),
        "scene": (
            Solid("ball", "sphere", (0.1, 0.1, 0.1), ball, _UPRIGHT),
            Solid("wall", "box", (0.05, 2.0, 1.0), np.array([0.9, 0.0, 1.0]), _UPRIGHT),
        ),
        "mode": MODES[index % len(MODES)],
        "motors": _motors(index, rng),
        "link": {"state_rate_hz": 200.0, "state_lost": 0.01 * index, "mode_machine": 5.0},
        "events": ("ball thrown", "second line") if index == 1 else (),
    }


def _motors(index: int, rng: np.random.Generator) -> MotorReadings:
    faults = np.zeros(29, np.int64)
    faults[4] = 0x80000000
    return MotorReadings(
        torque=rng.normal(0, 10, 29),
        temperature=30.0 + rng.uniform(0, 10, (29, 2)),
        faults=faults,
        enabled=np.arange(29) != 4,
    )


def _value_map(hand: Any, rng: np.random.Generator) -> ValueMap:
    x, z = np.linspace(0, 0.5, 6, dtype=np.float32), np.linspace(-0.2, 0.5, 4, dtype=np.float32)
    return ValueMap(hand, x, 0.25, z, rng.normal(size=(4, 6)).astype(np.float32))


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Path]:
    """A disk of one megabyte."""
    folder = tmp_path / "small"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("only the superuser may mount a small file system")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)
