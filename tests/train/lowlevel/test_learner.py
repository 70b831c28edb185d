"""Start from a trained controller, and the warm-up of the critic."""

import copy

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from egovcp.errors import UsageError
from egovcp.robot.controllers import load_walk_policy
from egovcp.robot.walking import OBSERVATION_DIM, WalkConfig
from egovcp.sim.config import SensorConfig
from egovcp_train.lowlevel.config import CurriculumConfig, LowLevelTask, NetworkConfig
from egovcp_train.lowlevel.env import LowLevelEnv, mirrored
from egovcp_train.lowlevel.learner import LowLevelLearner, SymmetricStart
from egovcp_train.lowlevel.sensing import PRIVILEGED_DIM
from egovcp_train.lowlevel.train import main
from egovcp_train.on_policy import RslRlPpoConfig


def _learner(critic_warmup: int, **network: object) -> LowLevelLearner:
    env = LowLevelEnv(8, LowLevelTask(), WalkConfig(), SensorConfig())
    return LowLevelLearner(
        env, NetworkConfig(**network), RslRlPpoConfig(), CurriculumConfig(start=0.5), critic_warmup
    )


def _asymmetry(learner: LowLevelLearner, seen: TensorDict) -> float:
    actor = learner.ppo.get_policy()
    with torch.no_grad():
        action = actor(seen)
        other = actor(mirrored(learner.env, seen, None)[0])[len(action) :]
        reflected = mirrored(learner.env, None, action)[1][len(action) :]
    return float((other - reflected).square().mean().sqrt())


def test_the_actor_begins_as_the_controller():
    learner, policy = _learner(1), load_walk_policy("walk")
    learner.start_from(policy)
    seen = learner.env.get_observations()
    with torch.no_grad():
        action = learner.ppo.get_policy()(seen).numpy()
    np.testing.assert_allclose(action, policy(seen["policy"].numpy()), atol=1e-3)
    assert learner.env.logic.difficulty == 0.5


def test_the_warm_up_trains_the_critic_and_keeps_the_noise():
    learner = _learner(2)
    learner.start_from(load_walk_policy("walk"))
    scalars = [learner.iterate() for _ in range(2)]
    assert all(s["ppo/symmetric_error"] < 0.1 for s in scalars)
    assert scalars[-1]["ppo/action_std"] == pytest.approx(NetworkConfig().initial_std)
    assert scalars[-1]["ppo/learning_rate"] == RslRlPpoConfig().learning_rate


def test_a_warm_up_that_is_resumed_goes_on():
    policy = load_walk_policy("walk")
    learner = _learner(2)
    learner.start_from(policy)
    learner.iterate()
    state = copy.deepcopy(learner.state_dict())
    resumed = _learner(2)
    resumed.start_from(policy, resumed=True)
    resumed.load_state_dict(state)
    assert torch.equal(torch.get_rng_state(), state["torch_rng"])
    old, new = (each.ppo.get_policy().mlp.parameters() for each in (learner, resumed))
    assert all(torch.equal(a, b) for a, b in zip(old, new, strict=True))
    moments = resumed._start.optimizer.state_dict()["state"]
    assert all(each["step"] > 0 for each in moments.values())
    assert "ppo/symmetric_error" in resumed.iterate()
    assert "start_optimizer" not in resumed.state_dict()


def test_the_actor_becomes_symmetric():
    torch.manual_seed(0)
    learner, policy = _learner(1), load_walk_policy("walk")
    start = SymmetricStart(learner.ppo.get_policy(), policy)
    noise = torch.randn(2048, OBSERVATION_DIM) * torch.from_numpy(policy.std)
    seen = torch.from_numpy(policy.mean) + 0.5 * noise
    heldout = TensorDict({"policy": seen[:256]}, batch_size=[256])
    heldout["privileged"] = torch.zeros(256, PRIVILEGED_DIM)
    before = _asymmetry(learner, heldout)
    errors = [start.fit(learner.env, seen[256:]) for _ in range(30)]
    assert errors[-1] < 0.5 * errors[0]
    assert _asymmetry(learner, heldout) < 0.8 * before


def test_without_a_network_the_warm_up_leaves_the_actor_alone():
    learner = _learner(1)
    actor = learner.ppo.get_policy().mlp
    before = [p.clone() for p in actor.parameters()]
    learner.iterate()
    assert all(torch.equal(a, b) for a, b in zip(before, actor.parameters(), strict=True))
    learner.iterate()
    assert not torch.equal(before[0], next(iter(actor.parameters())))


def test_layers_of_other_sizes_are_refused():
    with pytest.raises(UsageError, match=r"--network\.actor=\[256, 128, 64\]"):
        _learner(0, actor=(16,)).start_from(load_walk_policy("walk"))


@pytest.mark.parametrize(("init", "code"), [("wolk", 2), ("none.safetensors", 4)])
def test_an_unknown_controller_is_refused_before_any_work(tmp_path, capsys, init, code):
    assert main([f"--output_dir={tmp_path / 'new'}", f"--init={init}"]) == code
    assert init in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
