"""The public checks accept what conforms and name what does not."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp import spec
from egovcp.artifact import save_artifact
from egovcp.checks import (
    ConformanceError,
    check_artifact,
    check_dataset,
    check_env,
    check_world_model,
)
from egovcp.data import DatasetConfig, DatasetWriter, Episode, Provenance
from egovcp.errors import ArtifactError, DataError
from egovcp.model import Carry, WorldModel
from egovcp.plan import PlannerConfig
from egovcp.robot_spec import RobotSpec
from egovcp.testing import toy_model
from tests.support.environments import CountingEnv, ToyObservation, ToyStep
from tests.support.models import CountingModel

DEBUG = toy_model().config


# --- world models ----------------------------------------------------------------------
def test_the_counting_model_conforms() -> None:
    check_world_model(CountingModel())


class _KeepsMemory(WorldModel):
    def observe(
        self, carry: Carry, action: Tensor, depth: Tensor, state: Tensor, is_first: Tensor
    ) -> Carry:
        return super().observe(carry, action, depth, state, torch.zeros_like(is_first))


class _MultipliesByZero(WorldModel):
    def advance(self, carry: Carry, action: Tensor, is_first: Tensor) -> Tensor:
        keep = (~is_first).float()[:, None]
        return self.transition(Carry(carry.h * keep, carry.z * keep), action * keep)


class _ChangesItsInput(WorldModel):
    def transition(self, carry: Carry, action: Tensor) -> Tensor:
        h = super().transition(carry, action)
        carry.h.add_(1.0)
        return h


class _MixesRows(WorldModel):
    def embed_near(self, near: Tensor, standardised: Tensor) -> Tensor:
        embedding = super().embed_near(near, standardised)
        return embedding - embedding.mean(0)


class _DrawsAtRandom(WorldModel):
    def observe(
        self, carry: Carry, action: Tensor, depth: Tensor, state: Tensor, is_first: Tensor
    ) -> Carry:
        found = super().observe(carry, action, depth, state, is_first)
        return found._replace(z=found.z + torch.randn_like(found.z))


class _AnswersLogits(WorldModel):
    def termination(self, carry: Carry) -> Tensor:
        return self.termination_logit(carry) - 2.0


class _KeepsADimension(WorldModel):
    def value(self, carry: Carry, action: Tensor) -> Tensor:
        return super().value(carry, action)[..., None]


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (_KeepsMemory, "does not forget the memory"),
        (_MultipliesByZero, "does not forget a memory of NaN"),
        (_ChangesItsInput, "changes its input"),
        (_MixesRows, "rows of a batch influence"),
        (_DrawsAtRandom, "second time"),
        (_AnswersLogits, "not a probability"),
        (_KeepsADimension, "value has shape"),
    ],
)
def test_a_broken_contract_of_a_model_is_reported(broken: type[WorldModel], message: str) -> None:
    model = broken(DEBUG).eval()
    model.load_state_dict(toy_model().state_dict())
    with pytest.raises(ConformanceError, match=message):
        check_world_model(model)


def test_weights_that_are_not_numbers_are_found() -> None:
    model = toy_model()
    with torch.no_grad():
        model.gru.norm.weight.fill_(torch.nan)
    with pytest.raises(ConformanceError):
        check_world_model(model)


# --- artifacts -------------------------------------------------------------------------
def _save(path: Path, model: WorldModel) -> str:
    planner = PlannerConfig(samples=16, elites=4)
    save_artifact(path, model, planner, {"controller_id": "stance-1"})
    return str(path)


def test_a_good_artifact_passes(tmp_path: Path) -> None:
    artifact = check_artifact(_save(tmp_path / "policy", toy_model()))
    assert artifact.controller_id == "stance-1"


def test_an_artifact_of_another_robot_passes(tmp_path: Path) -> None:
    arm = RobotSpec(
        robot_type="arm",
        depth=(32, 48),
        depth_max_m=1.5,
        planner_hz=20,
        state_names=("angle", "speed", "height"),
        action_names=("lift", "grip"),
        action_box=spec.ActionBox((-1.0, 0.0), (0.0, 0.5), (1.0, 1.0)),
    )
    assert check_artifact(_save(tmp_path / "policy", toy_model(robot=arm))).robot == arm


@pytest.mark.parametrize("name", ["value_head", "gru"])
def test_an_artifact_with_nan_weights_is_refused(tmp_path: Path, name: str) -> None:
    model = toy_model()
    with torch.no_grad():
        for parameter in getattr(model, name).parameters():
            parameter.fill_(torch.nan)
    with pytest.raises(ArtifactError, match=r"model\.safetensors: .* holds NaN"):
        check_artifact(_save(tmp_path / "policy", model))


# --- environments ----------------------------------------------------------------------
def test_the_counting_environment_conforms() -> None:
    check_env(CountingEnv(3), [10, 4, 0])


class _Altered(CountingEnv):
    """Changes what the environment brings after its third tick."""

    calls = 0

    def step(self, action: NDArray[np.floating]) -> ToyStep:
        step = super().step(action)
        self.calls += 1
        return self.alter(step) if self._tick.max() >= 3 else step

    def alter(self, step: ToyStep) -> ToyStep:
        raise NotImplementedError


class _LateCommand(_Altered):
    def alter(self, step: ToyStep) -> ToyStep:
        state = step.observation.state.copy()
        state[:, spec.STATE_SLICES["command_hands"]] += 0.01
        return dataclasses.replace(step, observation=ToyObservation(step.observation.depth, state))


class _Jumps(_Altered):
    def step(self, action: NDArray[np.floating]) -> ToyStep:
        if self._tick.max() >= 3:
            self._sent = np.clip(np.asarray(action, dtype=np.float64), -1, 1)
        return CountingEnv.step(self, action)


class _WrongSum(_Altered):
    def alter(self, step: ToyStep) -> ToyStep:
        return dataclasses.replace(step, reward=step.reward + 1.0)


class _BothEnds(_Altered):
    def alter(self, step: ToyStep) -> ToyStep:
        both = np.ones(self.num_envs, dtype=np.bool_)
        return dataclasses.replace(step, terminated=both, truncated=both)


class _RisesAgain(_Altered):
    def alter(self, step: ToyStep) -> ToyStep:
        nobody = np.zeros(self.num_envs, dtype=np.bool_)
        return dataclasses.replace(step, terminated=nobody, truncated=nobody)


class _PaysLate(_Altered):
    def alter(self, step: ToyStep) -> ToyStep:
        ones = np.ones(self.num_envs)
        return dataclasses.replace(step, reward=ones, reward_terms={"pay": ones})


class _Wanders(_Altered):
    def alter(self, step: ToyStep) -> ToyStep:
        depth = step.observation.depth + np.uint16(self.calls)
        return dataclasses.replace(step, observation=ToyObservation(depth, step.observation.state))


class _OtherShape(_Altered):
    def alter(self, step: ToyStep) -> ToyStep:
        seen = step.observation
        return dataclasses.replace(
            step, observation=ToyObservation(seen.depth[..., None], seen.state)
        )


class _NotANumber(_Altered):
    def alter(self, step: ToyStep) -> ToyStep:
        state = step.observation.state.copy()
        state[0, 20] = np.nan
        return dataclasses.replace(step, observation=ToyObservation(step.observation.depth, state))


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (_LateCommand, "tick 3: the command in the state is not the last one sent"),
        (_Jumps, "above the rate limit of 0.32; limit it in step"),
        (_WrongSum, "tick 3: reward is not the sum of its terms"),
        (_BothEnds, "tick 3: a row is terminated and truncated at once"),
        (_RisesAgain, "an episode continues after its end"),
        (_PaysLate, r"rewards \[1\.\] in rows \[\d\] after the end of their episodes; expected 0"),
        (_Wanders, "depth differs between two runs with the same actions"),
        (_OtherShape, r"tick 3: depth is uint16 \(2, 48, 64, 1\)"),
        (_NotANumber, "tick 3: state is not finite"),
    ],
)
def test_a_broken_contract_of_an_environment_is_reported(
    broken: type[CountingEnv], message: str
) -> None:
    with pytest.raises(ConformanceError, match=message):
        check_env(broken(2), [10, 2])


# --- datasets --------------------------------------------------------------------------
def _walk(length: int, shift: int = 0) -> Episode:
    """An episode of `CountingEnv`; ``shift`` moves its states in time."""
    env, rng = CountingEnv(1), np.random.default_rng(0)
    seen, steps, actions = env.reset([length]), [], rng.uniform(-0.9, 0.9, (length, 1, 7))
    depths, states = [], []
    for action in actions:
        depths.append(seen.depth[0])
        states.append(seen.state[0])
        steps.append(env.step(action))
        seen = steps[-1].observation
    last = np.arange(length) == length - 1
    return Episode(
        depth=np.stack(depths),
        state=np.roll(np.stack(states), shift, axis=0),
        action=np.concatenate([s.sent_action for s in steps]).astype(np.float32),
        reward=np.concatenate([s.reward for s in steps]).astype(np.float32),
        done=last,
        success=np.zeros(length, dtype=np.bool_),
        truncated=last,
        task="ball",
        time_limit=length,
    )


def _write(root: Path, *episodes: Episode) -> DatasetConfig:
    with DatasetWriter(root, Provenance("counting")) as writer:
        for episode in episodes:
            writer.add(episode)
    return DatasetConfig(root=str(root))


def test_a_dataset_whose_rows_line_up_passes(tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    config = _write(tmp_path / "data", _walk(9), _walk(5))
    check_dataset(config, lambda now, total: done.append((now, total)))
    assert done == [(1, 2), (2, 2)]


@pytest.mark.parametrize("shift", [-1, 1])
def test_a_dataset_shifted_in_time_is_refused(tmp_path: Path, shift: int) -> None:
    config = _write(tmp_path / "data", _walk(9), _walk(5, shift))
    with pytest.raises(DataError, match=r"episode 1, frame \d: the command.*one tick before"):
        check_dataset(config)


def test_an_episode_is_validated_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, calls = _write(tmp_path / "data", _walk(9), _walk(5)), list[str]()
    for name in ("problems", "digest"):
        function = getattr(Episode, name)
        monkeypatch.setattr(
            Episode, name, lambda self, n=name, f=function: (calls.append(n), f(self))[1]
        )
    check_dataset(config)
    assert sorted(calls) == ["digest", "digest", "problems", "problems"]
