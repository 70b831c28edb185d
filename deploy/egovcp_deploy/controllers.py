"""Reference controllers, and the search for the best constant action."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.bounds import as_flag_value
from egovcp.decode import decode
from egovcp.errors import DataError, UsageError
from egovcp.files import UnsafeFileError, read_json
from egovcp.flags import merged
from egovcp.plan import PolicyStep
from egovcp.sim.base_env import BaseVectorEnv
from egovcp.sim.policies import Constant, EnvPolicy, Hold, Oracle, RandomWalk
from egovcp.sim.scenario import SEARCH, Scenario
from egovcp.sim.tasks.registry import find_task, task_names
from egovcp.spec import ACTION_DIM
from egovcp.terminal import echo
from egovcp.values import differences
from egovcp_deploy.options import PLANNER
from egovcp_deploy.scores import EpisodeScore, eval_scores

type Action = tuple[float, ...]
#: Plays all scenarios with each action; returns the scores of each action.
type PlayConstants = Callable[[Sequence[Action], Sequence[Scenario]], list[list[EpisodeScore]]]

CONSTANT: Final = "constant"
PPO: Final = "ppo"
DEFAULT_CONTROLLERS: Final = (PLANNER, "hold", CONSTANT, "random", "oracle")

_REDUCTION: Final = 4  # a quarter of the candidates advances to the next round
_FIRST_ROUND: Final = 6  # scenarios that every candidate plays


def reference(name: str, action: Action = ()) -> EnvPolicy:
    """``hold``, ``random``, ``oracle``, or ``constant`` with its ``action``."""
    if name == CONSTANT:
        return Constant(action)
    policies: dict[str, type[EnvPolicy]] = {"hold": Hold, "random": RandomWalk, "oracle": Oracle}
    return policies[name]()


class ReferencePolicy:
    """Adapts an `EnvPolicy` to `RolloutPolicy`: it acts on the environment, not on observations;
    ``scenarios()`` returns the scenarios of the current episodes."""

    def __init__(
        self, policy: EnvPolicy, env: BaseVectorEnv, scenarios: Callable[[], Sequence[Scenario]]
    ) -> None:
        self._policy, self._env, self._scenarios = policy, env, scenarios

    def reset(self) -> None:
        """Every robot has just begun an episode."""
        self._policy.reset(self._env, self._scenarios())

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """The actions of the reference; no plans."""
        return PolicyStep(self._policy.act(self._env))  # type: ignore[arg-type]  # float64

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        """Do nothing: references do not use observations."""

    def advance(self, sent: NDArray[np.floating]) -> None:
        """Do nothing."""


# --- the best constant action ----------------------------------------------------------------
@dataclass(frozen=True)
class BestConstant:
    """Result of the search."""

    action: tuple[float, ...]  # not `Action`, which `decode` does not know
    reward_mean: float  # per step, on the scenarios of the search
    success_rate: float
    episodes: int  # scenarios that it played


def candidate_actions(task: str) -> list[Action]:
    """`BaseTask.constant_actions`, and the neutral pose."""
    kind = find_task(task)
    neutral = (0.0,) * kind.robot_spec().action_dim
    return [neutral, *kind.constant_actions()]


def search_constant(task: str, seed: int, play: PlayConstants) -> BestConstant:
    """The candidate action with the highest mean reward per step, by successive halving.

    Every candidate plays the same few scenarios; the best quarter play more of them, until one is
    left. No evaluation plays these scenarios."""
    scores: dict[Action, list[EpisodeScore]] = {action: [] for action in candidate_actions(task)}
    candidates, count = list(scores), _FIRST_ROUND
    while len(candidates) > 1 or not scores[candidates[0]]:
        first = len(scores[candidates[0]])
        scenarios = [Scenario(task, SEARCH + seed, first + i) for i in range(count)]
        for action, played in zip(candidates, play(candidates, scenarios), strict=True):
            scores[action] += played
        candidates.sort(key=lambda action: -eval_scores(scores[action]).reward_per_step)
        candidates, count = candidates[: max(1, len(candidates) // _REDUCTION)], count * 2
    best = eval_scores(scores[candidates[0]])
    return BestConstant(candidates[0], best.reward_per_step, best.success_rate, best.success.size)


def load_constants(path: Path, setting: Mapping[str, Any]) -> dict[str, BestConstant]:
    """Task -> result, from the ``constant.json`` of an earlier evaluation in the same ``setting``
    (controller and environment); if the file records none, a warning is printed. Raises
    `DataError` if it is missing or of another format, `UsageError` if the settings differ."""
    try:
        content = read_json(path)
        constants = {task: _parse(task, entry) for task, entry in content["constants"].items()}
        known = {name: content[name] for name in setting if name in content}
    except (OSError, UnsafeFileError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise DataError(f"cannot read --constant.path={path}: {reason}") from error
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(
            f"--constant.path={path} is not the constant.json of an evaluation: {error!r}"
        ) from error
    if not known:
        echo(
            f"warning: --constant.path={path} records no controller and environment; they are not "
            "checked",
            error=True,
        )
    # An option that the file lacks is one of a later version, and unknown.
    for name, (old, new) in differences(merged(setting, known), setting):
        raise UsageError(
            f"--constant.path={path} was found with {name}={as_flag_value(old)}, expected "
            f"{as_flag_value(new)}; omit --constant.path to search for the best action again"
        )
    return constants


def _parse(task: str, entry: Any) -> BestConstant:
    constant = decode(BestConstant, entry, f"constants.{task}")
    size = find_task(task).robot_spec().action_dim if task in task_names() else ACTION_DIM
    if len(constant.action) != size or not np.all(np.abs(constant.action) <= 1.0):
        raise ValueError(f"expected {size} numbers from -1 to 1, found {constant.action}")
    return constant
