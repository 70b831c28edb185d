"""The errors of Q along plans, against what the plans were really worth (section III-D).

    e_k = Q^(h_k, z^_k, a_k) - Q(s_k, a_k),    k = 0 .. N-1

Q^ is what the model says along a plan that it imagines. Q is what the data's random walk earns from
there: the simulator is brought to the same state again, follows the plan up to a_k, and walks on at
random, several times over. Where the data's walk rests between its steps, a_k may be anywhere in a
rest: how long that goes on is drawn, too. The mean of these returns has an error of its own, whose
variance is known and taken off; errors of different k come from different walks and do not mix.

Two kinds of plans: the planner's own, which were chosen for their Q^, and random ones.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp.artifact import Artifact, returns_of
from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.model import Carry, WorldModel
from egovcp.plan.search import random_walk
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import StepResult, VectorEnv
from egovcp.sim.policies import RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_DIM, ACTION_ETA
from egovcp_experiment.studies.study import finish
from egovcp_experiment.studies.watching import Moment, WatchConfig, Watcher, watch
from egovcp_experiment.variance import Residuals, analysis

PROG: Final = "python -m egovcp_experiment.studies.residuals"
STEPS: Final = 6  # the longest horizon of table I
#: Ticks from the event to the moment of a plan; episodes take them in turn.
_AFTER: Final = {"ball": (-5, 4, 8, 12, 16), "wall": (-5, 1, 4, 8), "arch": (-2, 20, 40, 60, 80)}

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class ResidualsConfig(WatchConfig):
    """Errors of Q along plans, one plan of each kind in every episode."""

    branches: int = 12
    """Random walks that the worth of a step is the mean of."""
    eta: float = ACTION_ETA
    """egovcp-collect's, of the data that Q was trained on; so are the next two."""
    step_ticks: tuple[int, int] = (1, 1)
    """Shortest and longest time from one step of the walk to the next, planner ticks."""
    boundary: Literal["reflect", "clip"] = "reflect"
    """What keeps the walk inside the action box."""

    def random_walk(self) -> RandomWalk:
        """The data's."""
        return RandomWalk(self.eta, self.boundary, self.step_ticks)


@dataclass
class _Point:
    """The moment of a plan."""

    scenario: Scenario
    tick: int
    sent: list[Array]
    """Actions up to here."""
    plans: dict[str, Array]
    """Kind -> (STEPS, 7)."""
    values: dict[str, Array]
    """Kind -> (STEPS,) what the model says."""


class _Points(Watcher):
    """Keeps one moment of every episode."""

    def __init__(self, task: str, artifact: Artifact, seed: int) -> None:
        self._after, self._model = _AFTER[task], artifact.world_model
        self._eta = artifact.planner.eta
        self._generator = torch.Generator().manual_seed(seed)
        self.points: list[_Point] = []

    def begin(self, scenarios: Sequence[Scenario]) -> None:
        self._scenarios = tuple(scenarios)
        self._sent: list[list[Array]] = [[] for _ in scenarios]

    def before(self, moment: Moment) -> None:
        for row in np.flatnonzero(moment.live).tolist():
            scenario = self._scenarios[row]
            event = int(moment.env.parameters[row]["event_tick"])
            due = max(0, event + self._after[scenario.episode % len(self._after)])
            if int(moment.env.tick[row]) == due:
                self.points.append(self._point(moment, row, scenario))

    def after(self, moment: Moment, result: StepResult) -> None:
        for row in np.flatnonzero(moment.live).tolist():
            self._sent[row].append(result.sent_action[row].copy())

    def _point(self, moment: Moment, row: int, scenario: Scenario) -> _Point:
        start = self._sent[row][-1] if self._sent[row] else np.zeros(ACTION_DIM)
        deltas = 2 * torch.rand(STEPS, ACTION_DIM, generator=self._generator) - 1
        executed = torch.as_tensor(start, dtype=torch.float32)
        plans = {
            "planner": moment.step.plan[row].astype(np.float64),
            "random": random_walk(executed, deltas, self._eta).double().numpy(),
        }
        carry = moment.policy.carry.row(row)
        values = {kind: _values(self._model, carry, plan) for kind, plan in plans.items()}
        tick = int(moment.env.tick[row])
        return _Point(scenario, tick, list(self._sent[row]), plans, values)


@torch.no_grad()
def _values(model: WorldModel, carry: Carry, plan: Array) -> Array:
    """(STEPS,) Q^ along the plan."""
    actions = torch.as_tensor(plan).to(carry.h)
    found = []
    for action in actions:
        found.append(float(model.value(carry, action[None])))
        carry = model.imagine(carry, action[None])
    return np.array(found)


def measure(config: ResidualsConfig) -> None:
    """Plan, branch, and write the errors."""
    if config.task not in _AFTER:
        raise UsageError(f"--task={config.task}: expected one of {', '.join(_AFTER)}")
    if config.branches < 2:
        raise UsageError(f"--branches={config.branches}: expected at least 2")
    least, most = config.step_ticks
    if not 1 <= least <= most or not 0 < config.eta <= 2:
        raise UsageError(
            f"--eta={config.eta} --step_ticks={[least, most]}: expected a step within the box, at "
            "most 2, and 1 <= shortest <= longest; the data's card says how its walk stepped"
        )
    artifact = config.artifact()
    points = _Points(config.task, artifact, config.seed)
    longest = replace(artifact, planner=replace(artifact.planner, horizon=STEPS))
    watch(longest, config.env, config, points)
    returns = _returns(artifact)
    found: dict[str, list[Residuals]] = {}
    for number, point in enumerate(tqdm(points.points, unit="plan", desc="branch")):
        for kind, plan in point.plans.items():
            rng = np.random.default_rng([config.seed, number])
            rngs = rng.spawn(STEPS * config.branches)
            worth = _branches(config.env, point, plan, config.random_walk(), rngs, *returns)
            found.setdefault(kind, []).append(Residuals(point.values[kind], *worth))
    finish(
        config,
        {
            "task": config.task,
            "branches": config.branches,
            "return_steps": returns[1],
            "return_std": float(artifact.world_model.return_std),
            "plans": {kind: analysis(rows) for kind, rows in found.items()},
        },
    )


def _returns(artifact: Artifact) -> tuple[float, int]:
    """Discount and ticks of the return that Q was trained on."""
    if not artifact.manifest.get("train_config", {}).get("returns"):
        raise UsageError(f"{artifact.path} does not say which return it was trained on")
    returns = returns_of(artifact)
    return returns.gamma, returns.steps


def _branches(
    env_config: EnvConfig,
    point: _Point,
    plan: Array,
    walk: RandomWalk,
    rngs: Sequence[np.random.Generator],
    gamma: float,
    steps: int,
) -> tuple[Array, Array]:
    """(STEPS, branches) returns over ``steps`` ticks, and to the end of the episode, from each step
    of the plan on; each of (STEPS * branches) ``rngs`` makes one branch."""
    rows = len(rngs)
    env = VectorEnv(env_config, rows, render_depth=False)
    env.reset([point.scenario] * rows)
    for action in point.sent:
        env.step(np.tile(action, (rows, 1)))
    own = np.repeat(np.arange(STEPS), rows // STEPS)  # the step of the plan that a row is about
    short, whole = np.zeros(rows), np.zeros(rows)
    walk.start_at(np.zeros((rows, ACTION_DIM)), rngs)
    age = 0
    while not env.done.all():
        over = np.flatnonzero(own == age - 1)
        walk.start_rows_at(over.tolist(), env.sent_action[over])
        action = walk.act(env)
        planned = own >= age
        action[planned] = plan[min(age, STEPS - 1)]
        reward = env.step(action).reward
        since = age - own
        discount = np.where(since >= 0, gamma ** np.maximum(since, 0), 0.0)
        whole += discount * reward
        short += np.where(since < steps, discount, 0.0) * reward
        age += 1
    env.close()
    return short.reshape(STEPS, -1), whole.reshape(STEPS, -1)


CONFIG = ResidualsConfig


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(CONFIG, measure, argv, prog=PROG)


if __name__ == "__main__":
    sys.exit(main())
