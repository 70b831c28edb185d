from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from egovcp.sim.config import EnvConfig
from egovcp.sim.gym import EgovcpEnv, register


@pytest.fixture(scope="module")
def env(config: EnvConfig) -> EgovcpEnv:
    return EgovcpEnv("ball", config)


@pytest.mark.filterwarnings("ignore:.*Box observation space.*")
def test_it_passes_gymnasiums_own_check(env: EgovcpEnv) -> None:
    check_env(env, skip_render_check=True)


def test_registered_names_make_the_environment() -> None:
    register()
    register()
    assert gymnasium.spec("egovcp/wall-v0").kwargs == {"task": "wall"}


def test_a_seed_starts_its_first_episode_and_no_seed_the_next(env: EgovcpEnv) -> None:
    first, info = env.reset(seed=4)
    second, next_info = env.reset()
    again, _ = env.reset(seed=4)
    assert (info["episode"], next_info["episode"]) == (0, 1)
    np.testing.assert_array_equal(first["state"], again["state"])
    assert not np.array_equal(first["state"], second["state"])


def test_info_names_success_action_and_reward_terms(env: EgovcpEnv) -> None:
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.full(7, 0.1, dtype=np.float32))
    assert reward == pytest.approx(sum(info["reward_terms"].values()))
    assert info["success"] is False
    np.testing.assert_allclose(info["sent_action"], 0.1)
