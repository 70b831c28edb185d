"""Errors of Q along plans against simulated returns, and their variance (section III-D).

    e_k = Q^(h_k, z^_k, a_k) - Q(s_k, a_k),    k = 0 .. N-1

Q^ is the model's value along an imagined plan. Q is the mean return of the data's random walk from
there: the simulator is reset to the same state, follows the plan up to a_k, and continues with
several random walks. Returns weight the reward terms as those of the training (returns.weights).
With step_ticks > 1, the time to the walk's next step is sampled, too. The sampling variance of the
mean is subtracted; errors of different k use different walks. So e_k is an error of Q only if Q was
trained on such returns: with q_target=mc, on data of the same walk.

    E[(J_N - J^_N)^2] = 1/N^2 sum_ij Cov[e_i, e_j] + bias^2
    V_ub = (N + rho (N^2 - N)) / N^2 sigma_max^2
    V_lb = max((N sigma_min^2 - rho (N^2 - N) sigma_max^2) / N^2, 0)

There are two kinds of plans: the planner's own, which maximise Q^, and random ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
import torch
from tqdm import tqdm

from egovcp.artifact import Artifact, returns_of
from egovcp.bounds import bounded
from egovcp.data import ReturnConfig
from egovcp.errors import UsageError
from egovcp.eval_scores import Array, bootstrap
from egovcp.model import Carry, WorldModel
from egovcp.plan.search import random_walk
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.policies import RandomWalk, require_ordered_steps
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_DIM, HELD_ETA, HELD_TICKS, REWARD_TERMS
from egovcp.terminal import echo
from egovcp_experiment.studies import study

STEPS: Final = 6  # the longest horizon of table I
_NEGLIGIBLE: Final = 0.01  # share of the largest variance of a step
#: Ticks from the event to the plan; episodes take them in turn.
_AFTER: Final = {"ball": (-5, 4, 8, 12, 16), "wall": (-5, 1, 4, 8), "arch": (-2, 20, 40, 60, 80)}


@dataclass(frozen=True)
class ResidualsConfig(study.SimStudyConfig):
    """Q along plans minus simulated returns, for one plan of each kind per episode: errors of Q
    only for a policy trained with q_target=mc on data of the same walk."""

    branches: int = bounded(12, least=2)
    """Random walks per step of a plan; their mean return is what Q is compared with."""
    eta: float = bounded(HELD_ETA, above=0, most=2)
    """Largest step of the data's random walk, normalised action units ([-1, 1])."""
    step_ticks: tuple[int, int] = bounded(HELD_TICKS, least=1, most=100_000)
    """Shortest and longest interval between steps of the walk, planner ticks."""
    boundary: Literal["reflect", "clip"] = "reflect"
    """What keeps the walk inside the action box."""

    def check(self) -> None:
        """See `StudyConfig.check`."""
        super().check()
        require_ordered_steps(self.step_ticks)

    def load(self) -> Artifact:
        """As `SimStudyConfig.load`; warns if Q was not trained on returns."""
        artifact = super().load()
        target = artifact.world_model.config.loss.q_target
        if target != "mc":
            echo(
                f"warning: Q of {artifact.path} was trained with q_target={target}, not on returns "
                "(mc): its differences from returns of random walks are not errors",
                error=True,
            )
        return artifact


@dataclass
class _Start:
    """Start of the plans in an episode."""

    scenario: Scenario
    sent: list[Array]
    """Actions before."""
    plans: dict[str, Array]
    """Kind -> (STEPS, 7)."""
    values: dict[str, Array]
    """Kind -> (STEPS,) Q^ along the plan."""


def _starts(artifact: Artifact, config: ResidualsConfig) -> list[_Start]:
    """At most one start per episode."""
    after, eta = _AFTER[config.task], artifact.planner.eta
    generator = torch.Generator().manual_seed(config.seed)
    longest = replace(artifact, planner=replace(artifact.planner, horizon=STEPS))
    sent: dict[int, list[Array]] = {episode: [] for episode in range(config.episodes)}
    starts = []
    for step in study.play_episodes(longest, config.env, config):
        for row in step.live:
            scenario = step.scenarios[row]
            past = sent[scenario.episode]
            event = int(step.env.parameters[row]["event_tick"])
            if int(step.tick[row]) == max(0, event + after[scenario.episode % len(after)]):
                deltas = 2 * torch.rand(STEPS, ACTION_DIM, generator=generator) - 1
                executed = torch.as_tensor(step.sent_before[row], dtype=torch.float32)
                plans = {
                    "planner": step.decision.plan[row].astype(np.float64),
                    "random": random_walk(executed, deltas, eta).double().numpy(),
                }
                carry = step.carry.row(row)
                values = {k: _values(artifact.world_model, carry, p) for k, p in plans.items()}
                starts.append(_Start(scenario, list(past), plans, values))
            past.append(step.result.sent_action[row].copy())
    return starts


@torch.no_grad()
def _values(model: WorldModel, carry: Carry, plan: Array) -> Array:
    """(STEPS,) Q^ along the plan."""
    found = []
    for action in torch.as_tensor(plan).to(carry.h):
        found.append(float(model.value(carry, action[None])))
        carry = model.imagine(carry, action[None])
    return np.array(found)


def measure(config: ResidualsConfig) -> None:
    """Plan, branch, and write the analysis."""
    config.require_task(_AFTER)
    artifact = config.load()
    if not artifact.manifest.get("train_config", {}).get("returns"):
        raise UsageError(f"{artifact.path} does not say which return it was trained on")
    returns = returns_of(artifact)
    starts = _starts(artifact, config)
    walk = RandomWalk(config.eta, config.boundary, config.step_ticks)
    found: dict[str, list[tuple[Array, Array, Array]]] = {}
    for number, start in enumerate(tqdm(starts, unit="plan", desc="branch")):
        for kind, plan in start.plans.items():
            rngs = np.random.default_rng([config.seed, number]).spawn(STEPS * config.branches)
            simulated = _branches(config.env, start, plan, walk, rngs, returns)
            found.setdefault(kind, []).append((start.values[kind], *simulated))
    config.write(
        {
            "task": config.task,
            "branches": config.branches,
            "return_steps": returns.steps,
            "return_std": float(artifact.world_model.return_std),
            "plans": {
                kind: analysis(*map(np.stack, zip(*rows, strict=True)))
                for kind, rows in found.items()
            },
        }
    )


def _branches(
    env_config: EnvConfig,
    start: _Start,
    plan: Array,
    walk: RandomWalk,
    rngs: Sequence[np.random.Generator],
    returns: ReturnConfig,
) -> tuple[Array, Array]:
    """(STEPS, branches) returns over ``returns.steps`` ticks, and to the end of the episode, from
    each step of the plan on; each of (STEPS * branches) ``rngs`` makes one branch."""
    with closing(VectorEnv(env_config, len(rngs), render_depth=False)) as env:
        return _returns(env, start, plan, walk, rngs, returns)


def _returns(
    env: VectorEnv,
    start: _Start,
    plan: Array,
    walk: RandomWalk,
    rngs: Sequence[np.random.Generator],
    config: ReturnConfig,
) -> tuple[Array, Array]:
    rows = len(rngs)
    env.reset([start.scenario] * rows)
    for action in start.sent:
        env.step(np.tile(action, (rows, 1)))
    own = np.repeat(np.arange(STEPS), rows // STEPS)  # the step of the plan that a row measures
    short, whole = np.zeros(rows), np.zeros(rows)
    walk.start_at(np.zeros((rows, ACTION_DIM)), rngs)
    of_column = dict(zip(REWARD_TERMS, config.term_weights, strict=True))
    columns = env.instances[0].task.reward_terms
    weights = {name: of_column[column] for name, column in columns.items()}
    age = 0
    while not env.done.all():
        over = np.flatnonzero(own == age - 1)
        walk.start_rows_at(over.tolist(), env.sent_action[over])
        action = walk.act(env)
        planned = own >= age
        action[planned] = plan[min(age, STEPS - 1)]
        terms = env.step(action).reward_terms
        reward = sum(weights[name] * values for name, values in terms.items())
        since = age - own
        discount = np.where(since >= 0, config.gamma ** np.maximum(since, 0), 0.0)
        whole += discount * reward
        short += np.where(since < config.steps, discount, 0.0) * reward
        age += 1
    return short.reshape(STEPS, -1), whole.reshape(STEPS, -1)


def analysis(value: Array, short: Array, whole: Array) -> dict[str, Any]:
    """Variances, correlations, bounds and biases, of fewer than three plans only their number.

    Intervals are 95 % bootstrap intervals over plans. ``share_4`` is the variance of J_4's error
    over that of J_1; it and its interval are None if the interval of the latter reaches zero or 1 %
    of the largest variance of a step.

    Args:
        value: (P, K) Q^ along P plans of K steps.
        short: (P, K, R) returns of random walks from each step, with the horizon of training.
        whole: (P, K, R) the same to the end of the episode.
    """
    if len(value) < 3:
        return {"plans": len(value)}
    errors = value - short.mean(2)  # (P, K)
    noise = short.var(2, ddof=1) / short.shape[2]
    covariance = _covariance(errors, noise)
    rho = _correlation(_positive(covariance))
    cut = (short - whole).mean(2)

    def interval(statistic: Callable[[Array], Array]) -> list[float]:
        return list(bootstrap(lambda i: statistic(_covariance(errors[i], noise[i])), len(errors)))

    known = interval(lambda found: found[:, 0, 0])[0] > _NEGLIGIBLE * covariance.diagonal().max()
    positive = _positive(covariance)
    return {
        "plans": len(value),
        "sigma": np.sqrt(np.diag(positive)).tolist(),
        "rho": rho.tolist(),
        "rho_max": _largest(rho),
        "rho_next": float(_rho_next(covariance)),
        "rho_next_ci95": interval(_rho_next),
        "share_4": float(_share(covariance)) if known else None,
        "share_4_ci95": interval(_share) if known else None,
        "return_noise_variance": noise.mean(0).tolist(),
        "bias": errors.mean(0).tolist(),
        "bias_of_cutting": cut.mean(0).tolist(),
        "horizons": [_horizon(n, positive, errors) for n in range(1, len(positive) + 1)],
    }


def _covariance(errors: Array, noise: Array) -> Array:
    """(..., K, K) from errors (..., P, K), less the variances (..., P, K) of the mean returns."""
    centred = errors - errors.mean(-2, keepdims=True)
    covariance = centred.swapaxes(-1, -2) @ centred / (errors.shape[-2] - 1)
    found: Array = covariance - noise.mean(-2)[..., None] * np.eye(errors.shape[-1])
    return found


def _positive(covariance: Array) -> Array:
    """The nearest positive semidefinite matrices: subtracting noise may give negative variances."""
    values, vectors = np.linalg.eigh(covariance)
    fixed: Array = (vectors * np.maximum(values, 0.0)[..., None, :]) @ vectors.swapaxes(-1, -2)
    return fixed


def _correlation(covariance: Array) -> Array:
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    scale = sigma[..., None] * sigma[..., None, :]
    one = np.broadcast_to(np.eye(sigma.shape[-1]), covariance.shape).copy()
    rho: Array = np.divide(covariance, scale, out=one, where=scale > 0)
    return rho


def _rho_next(covariance: Array) -> Array:
    """(...) mean correlation of neighbouring steps."""
    rho = _correlation(_positive(covariance))
    mean: Array = np.diagonal(rho, 1, axis1=-2, axis2=-1).mean(-1)
    return mean


def _share(covariance: Array) -> Array:
    """(...) variance of J_4's error over that of J_1."""
    part = _positive(covariance)[..., :4, :4]
    one = part[..., 0, 0]
    nothing = np.full_like(one, np.inf)
    share: Array = np.divide(part.mean((-2, -1)), one, out=nothing, where=one > 0)
    return share


def _largest(rho: Array) -> float:
    """The largest absolute correlation between two different steps."""
    apart = np.abs(rho[~np.eye(len(rho), dtype=bool)])
    return float(apart.max()) if len(apart) else 0.0


def _horizon(n: int, covariance: Array, errors: Array) -> dict[str, float]:
    """Variance, bounds, bias and mean square error of J_N."""
    part = covariance[:n, :n]
    sigma = np.sqrt(np.diag(part))
    rho = _largest(_correlation(part))
    low, high = bounds(n, float(sigma.min()), float(sigma.max()), rho)
    variance = float(part.sum()) / n**2
    bias = float(errors[:, :n].mean())
    return {
        "n": n,
        "variance": variance,
        "v_lb": low,
        "v_ub": high,
        "bias": bias,
        "error": variance + bias**2,
    }


def bounds(n: int, sigma_min: float, sigma_max: float, rho: float) -> tuple[float, float]:
    """V_lb and V_ub of the paper."""
    pairs = n * n - n
    low = (n * sigma_min**2 - rho * pairs * sigma_max**2) / n**2
    return max(low, 0.0), (n + rho * pairs) / n**2 * sigma_max**2


main = study.make_main("residuals", ResidualsConfig, measure)

if __name__ == "__main__":
    raise SystemExit(main())
