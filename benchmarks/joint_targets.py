"""Largest excess of each joint's target over the joint's range, rad (negative: margin).

`egovcp.robot.kinematics` derives from it how far targets may leave the range. Plays every task of
the G1 with each low-level controller that can play it, once with random hands and once with the
oracle (blocks, braces after pushes, walks under the arch). Robots that fall are left out, as
targets during a fall are arbitrary.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from report import parser, publish

from egovcp.robot.controllers import LowLevelController, make_controller
from egovcp.robot.kinematics import JOINT_LOWER, JOINT_UPPER
from egovcp.sim.config import evaluation_config
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import EnvPolicy, Oracle, RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.registry import find_task, select_tasks
from egovcp.spec import JOINT_NAMES

Array = NDArray[np.float64]


class TargetRecorder:
    """A controller that records the greatest excess of its targets, per robot."""

    def __init__(self, controller: LowLevelController, robots: int) -> None:
        self._controller = controller
        self.below = np.full((robots, len(JOINT_NAMES)), -np.inf)
        self.above = np.full((robots, len(JOINT_NAMES)), -np.inf)

    def __getattr__(self, name: str) -> object:
        return getattr(self._controller, name)

    def step(self, state: NDArray[np.floating]) -> Array:
        target = self._controller.step(state)
        if len(target) == len(self.above):  # not the single robot that settles first
            self.below = np.maximum(self.below, JOINT_LOWER - target)
            self.above = np.maximum(self.above, target - JOINT_UPPER)
        return target


def excess(which: str, task: str, policy: EnvPolicy, robots: int, seed: int) -> tuple[Array, Array]:
    """(29,) rad below and above the range, the greatest of all robots that did not fall."""
    recorder = TargetRecorder(make_controller(which), robots)
    config = replace(evaluation_config(), controller=which)
    env = VectorEnv(config, robots, recorder, render_depth=False)  # type: ignore[arg-type]
    scenarios = [Scenario(task, seed, i) for i in range(robots)]
    env.reset(scenarios)
    policy.reset(env, scenarios)
    while not env.done.all():
        env.step(policy.act(env))
    stood = np.array([not instance.terminated for instance in env.instances])
    below = recorder.below[stood].max(axis=0, initial=-np.inf)
    above = recorder.above[stood].max(axis=0, initial=-np.inf)
    return below, above


def main() -> None:
    p = parser(__doc__, rounds=None)
    p.add_argument(
        "--robots", type=int, default=16, help="episodes per controller, task and policy; 2 or more"
    )
    p.add_argument("--seed", type=int, default=5, help="of the scenarios")
    args = p.parse_args()
    if args.robots < 2:
        p.error(f"--robots={args.robots}: expected at least 2")
    below = np.full(len(JOINT_NAMES), -np.inf)
    above = below.copy()
    for which in ("walk", "stance"):
        for task in select_tasks("all", training=True):
            if find_task(task).needs_walking and which != "walk":
                continue
            for policy in (RandomWalk(), Oracle()):
                found = excess(which, task, policy, args.robots, args.seed)
                below, above = np.maximum(below, found[0]), np.maximum(above, found[1])
    metrics: dict[str, object] = {}
    for i, name in enumerate(JOINT_NAMES):
        metrics[f"{name}_below_rad"] = float(below[i])
        metrics[f"{name}_above_rad"] = float(above[i])
    publish(metrics, args.json)


if __name__ == "__main__":
    main()
