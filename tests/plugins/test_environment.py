"""The simulation as a LeRobot environment: the same episode, under LeRobot's names."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from lerobot.configs import PreTrainedConfig
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout

from egovcp import spec
from egovcp.artifact import load_artifact
from egovcp.errors import ArtifactError, UsageError
from egovcp.robot_spec import G1
from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.gym import EgovcpEnv
from lerobot_env_egovcp import EgovcpEnvConfig, LeRobotEgovcpEnv, configuration_egovcp

TICKS = 8
SIMULATION = EnvConfig(controller="stance", ball_episode=EpisodeConfig(TICKS, (2, 3)))


@pytest.fixture(scope="module")
def view() -> Iterator[LeRobotEgovcpEnv]:
    env = LeRobotEgovcpEnv("ball", SIMULATION)
    yield env
    env.close()


@pytest.fixture(scope="module")
def plain() -> Iterator[EgovcpEnv]:
    env = EgovcpEnv("ball", SIMULATION)
    yield env
    env.close()


@pytest.mark.filterwarnings("ignore:.*Box observation space.*")
def test_gymnasium_check_env_passes(view: LeRobotEgovcpEnv) -> None:
    check_env(view, skip_render_check=True)


def test_it_is_the_same_episode_under_other_names(view: LeRobotEgovcpEnv, plain: EgovcpEnv) -> None:
    action = np.full(spec.ACTION_DIM, 0.2, dtype=np.float32)
    (seen, _), (expected, _) = view.reset(seed=3), plain.reset(seed=3)
    for tick in range(TICKS):
        np.testing.assert_array_equal(seen["images.ego_depth"][0], expected["depth"])
        np.testing.assert_array_equal(seen["agent_pos"], expected["state"])
        seen, *outcome, info = view.step(action)
        expected, *expected_outcome, expected_info = plain.step(action)
        assert outcome == expected_outcome
        over = tick == TICKS - 1
        assert outcome[2] is over
        assert info["is_success"] is (over and expected_info["success"])


def test_a_success_counts_at_the_end_alone(
    view: LeRobotEgovcpEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = EgovcpEnv.step

    def succeed(self: EgovcpEnv, action: np.ndarray) -> tuple[object, ...]:
        *rest, info = step(self, action)
        return (*rest, info | {"success": True})

    monkeypatch.setattr(EgovcpEnv, "step", succeed)
    view.reset(seed=0)
    action = np.zeros(spec.ACTION_DIM, dtype=np.float32)
    found = [view.step(action)[-1]["is_success"] for _ in range(TICKS)]
    assert found == [False] * (TICKS - 1) + [True]


def test_the_rendered_image_is_bright_where_objects_are_near(view: LeRobotEgovcpEnv) -> None:
    seen, _ = view.reset(seed=0)
    depth, image = seen["images.ego_depth"][0], view.render()
    assert image.shape == (4 * spec.DEPTH_ROWS, 4 * spec.DEPTH_COLS, 3)
    grey = image[::4, ::4, 0].astype(int)
    assert (grey[depth == 0] == 0).all()
    order = depth[depth > 0].argsort()
    assert (np.diff(grey[depth > 0][order]) <= 0).all()


def test_a_rollout_of_lerobot_takes_the_actions_of_the_artifact(
    artifact: Path, plain: EgovcpEnv
) -> None:
    """The way of lerobot-eval: two robots side by side, each as if it were alone."""
    config = EgovcpEnvConfig(task="ball", simulation=SIMULATION)
    policy_config = PreTrainedConfig.from_pretrained(artifact)
    policy_config.pretrained_path, policy_config.device = artifact, "cpu"
    policy = make_policy(policy_config, env_cfg=config)
    envs = make_env(config, n_envs=2)
    try:
        played = rollout(
            envs["egovcp"][0],
            policy,
            *make_env_pre_post_processors(config, policy_config),
            *make_pre_post_processors(policy_config, str(artifact)),
            seeds=[5, 6],
        )
    finally:
        close_envs(envs)
    for row, seed in enumerate((5, 6)):
        alone = load_artifact(str(artifact)).make_policy()
        seen, _ = plain.reset(seed=seed)
        for tick in range(TICKS):
            action = alone.act(seen["depth"][None], seen["state"][None]).action
            alone.advance(action)
            torch.testing.assert_close(
                played["action"][row, tick], torch.from_numpy(action[0]), rtol=1e-3, atol=1e-4
            )
            seen, reward, *_ = plain.step(action[0])
            assert float(played["reward"][row, tick]) == pytest.approx(reward, abs=1e-4)
    assert played["done"][:, -1].all()
    assert not played["done"][:, -2].any()


def test_a_rollout_of_lerobot_with_another_controller_is_refused_before_its_first_step(
    artifact: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = EgovcpEnvConfig(task="ball", simulation=replace(SIMULATION, controller="walk"))
    policy_config = PreTrainedConfig.from_pretrained(artifact)
    policy_config.pretrained_path, policy_config.device = artifact, "cpu"
    policy = make_policy(policy_config, env_cfg=config)
    envs = make_env(config, n_envs=2)
    steps: list[object] = []
    monkeypatch.setattr(EgovcpEnv, "step", lambda *_: steps.append(1))
    try:
        with pytest.raises(ArtifactError, match=r"'g1-stance.*'g1-walk.*simulation\.controller"):
            rollout(
                envs["egovcp"][0],
                policy,
                *make_env_pre_post_processors(config, policy_config),
                *make_pre_post_processors(policy_config, str(artifact)),
                seeds=[5, 6],
            )
    finally:
        close_envs(envs)
    assert not steps


@pytest.mark.slow
def test_async_environments_work() -> None:
    envs = make_env(EgovcpEnvConfig(simulation=SIMULATION), n_envs=2, use_async_envs=True)
    try:
        env = envs["egovcp"][0]
        seen, _ = env.reset(seed=[0, 1])
        assert seen["images.ego_depth"].shape == (2, 1, spec.DEPTH_ROWS, spec.DEPTH_COLS)
        assert env.call("_max_episode_steps") == (TICKS, TICKS)
    finally:
        close_envs(envs)


def test_a_task_of_another_robot_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    task = SimpleNamespace(robot_spec=lambda: replace(G1, robot_type="planar_arm"))
    monkeypatch.setattr(configuration_egovcp, "find_task", lambda *_: task)
    with pytest.raises(UsageError, match=r"--env\.task=reach is of robot planar_arm"):
        EgovcpEnvConfig(task="reach")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "bal"}, "did you mean 'ball'"),
        ({"task": None}, "unknown task 'None'"),
        ({"fps": 30}, "25 Hz"),
    ],
)
def test_senseless_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        EgovcpEnvConfig(**options)
