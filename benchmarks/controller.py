"""Milliseconds per 20 ms step of the low-level controllers: one robot, and each of sixteen.

`stance` and `walk` are whole steps, from a measurement to joint targets; `network` is the trained
part of `walk` alone. One thread; the measurements are of standing robots with a walking command and
have little influence on the time.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy starts its threads

from collections.abc import Callable
from importlib import resources

import numpy as np
from report import interleaved, parser, publish

from egovcp.robot.controllers import make_controller
from egovcp.robot.stance_table import standing_pose
from egovcp.robot.walk_policy import WalkPolicy
from egovcp.robot.walking import OBSERVATION_DIM
from egovcp.spec import ACTION_BOX, STATE_DIM, STATE_SLICES

ROBOTS = (1, 16)


def measurements(robots: int) -> np.ndarray:
    """(robots, 74) near the standing pose, with a command to walk at 0.3 m/s."""
    pose = standing_pose(ACTION_BOX.neutral[-1])
    pitch = 2 * np.arctan2(pose.quaternion[2], pose.quaternion[0])
    state = np.zeros((robots, STATE_DIM))
    state[:, STATE_SLICES["projected_gravity"]] = (np.sin(pitch), 0.0, -np.cos(pitch))
    state[:, STATE_SLICES["joint_position"]] = pose.joints
    state[:, STATE_SLICES["joint_velocity"]] = np.random.default_rng(0).normal(
        0.0, 0.1, (robots, len(pose.joints))
    )
    state[:, STATE_SLICES["command_velocity"]] = (0.3, 0.0, 0.0)
    neutral = np.asarray(ACTION_BOX.neutral)
    state[:, STATE_SLICES["command_hands"]] = neutral[:-1]
    state[:, STATE_SLICES["command_height"]] = neutral[-1]
    return state


def shipped_network() -> WalkPolicy:
    """The network of the shipped controller."""
    file = resources.files("egovcp.robot").joinpath("g1_walk.safetensors")
    with resources.as_file(file) as path:
        return WalkPolicy.load(path)


def repeated(
    function: Callable[[np.ndarray], object], x: np.ndarray, times: int
) -> Callable[[], None]:
    """``times`` calls as one measurement, as a single one is too short to time."""

    def run() -> None:
        for _ in range(times):
            function(x)

    return run


def main() -> None:
    p = parser(__doc__)
    p.add_argument("--steps", type=int, default=50, help="control steps per measurement")
    args = p.parse_args()
    network = shipped_network()
    cases: dict[str, Callable[[], object]] = {}
    robots: dict[str, int] = {}
    for n in ROBOTS:
        which = "1_robot" if n == 1 else f"each_of_{n}"
        seen = np.random.default_rng(0).normal(size=(n, OBSERVATION_DIM)).astype(np.float32)
        steps = {name: (make_controller(name).step, measurements(n)) for name in ("stance", "walk")}
        for name, (step, x) in (steps | {"network": (network, seen)}).items():
            key = f"{name}_ms_{which}"
            robots[key] = n
            cases[key] = repeated(step, x, args.steps)
    seconds = interleaved(cases, args.rounds)
    metrics = {key: 1e3 * taken / (args.steps * robots[key]) for key, taken in seconds.items()}
    publish(metrics | {"steps": args.steps}, args.json)


if __name__ == "__main__":
    main()
