"""The task for GPUs, built and stepped on the CPU: the same numbers as the CPU environment's."""

from dataclasses import asdict
from importlib.metadata import entry_points

import numpy as np
import pytest
import torch

from egovcp.robot.g1 import STIFFNESS
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, WalkConfig
from egovcp.spec import JOINT_NAMES
from egovcp_train.lowlevel.config import DisturbanceConfig, LowLevelTask, RewardConfig
from egovcp_train.lowlevel.sensing import PRIVILEGED_DIM

# Warp compiles its kernels once
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

N = 3
PLAIN = DisturbanceConfig(
    push_interval=(90.0, 99.0),
    friction=(0.8, 0.8),
    payload=(0.0, 0.0),
    mass_scale=(1.0, 1.0),
    stiffness_scale=(1.0, 1.0),
    damping_scale=(1.0, 1.0),
)


@pytest.fixture(scope="module")
def task_module():
    """Imported by the one process that runs these tests: it takes seconds."""
    return pytest.importorskip("egovcp_train.lowlevel.mjlab_task")


@pytest.fixture(scope="module")
def env(task_module):
    import warp
    from mjlab.envs import ManagerBasedRlEnv

    warp.config.optimization_level = 0  # compiling takes longer than the few steps
    warp.config.cpu_compiler_flags = None
    cfg = task_module.env_cfg(N, LowLevelTask(disturbances=PLAIN), WalkConfig())
    cfg.seed = 0
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    yield env
    env.close()


def test_mjlab_finds_the_task_by_its_entry_point(task_module):
    from mjlab.tasks.registry import list_tasks

    (entry,) = entry_points(group="mjlab.tasks").select(name="egovcp")
    assert entry.load() is task_module
    assert task_module.TASK_ID in list_tasks()


def test_mjlabs_command_line_reaches_every_number(task_module):
    import tyro
    from mjlab import TYRO_FLAGS
    from mjlab.scripts.train import TrainConfig

    flags = ["--env.scene.num-envs", "7", "--env.commands.task-logic.walk.action-scale", "0.2"]
    config = tyro.cli(
        TrainConfig,
        args=[*flags, "--agent.algorithm.desired-kl", "0.03"],
        default=TrainConfig.from_task(task_module.TASK_ID),
        config=TYRO_FLAGS,
    )
    assert config.env.scene.num_envs == 7
    assert config.env.commands["task_logic"].walk.action_scale == 0.2
    assert config.agent.algorithm.desired_kl == 0.03


def test_the_robot_has_the_gains_and_feet_of_the_cpu_environment(env):
    model = env.sim.mj_model
    names = [model.actuator(i).name.split("/")[-1] for i in range(model.nu)]
    gains = {name: model.actuator_gainprm[i, 0] for i, name in enumerate(names)}
    np.testing.assert_allclose([gains[name] for name in JOINT_NAMES], STIFFNESS, rtol=1e-6)
    assert sum("_foot" in model.geom(i).name for i in range(model.ngeom)) == 8


def test_rewards_and_their_weights_are_those_of_the_cpu_environment(env):
    weights = {
        name: env.reward_manager.get_term_cfg(name).weight for name in asdict(RewardConfig())
    }
    assert weights == asdict(RewardConfig())


def test_robots_stand_for_a_while_without_a_policy(env):
    env.reset()
    for _ in range(25):
        obs, reward, terminated, truncated, _ = env.step(torch.zeros(N, ACTIONS))
    assert obs["policy"].shape == (N, OBSERVATION_DIM)
    assert obs["privileged"].shape == (N, PRIVILEGED_DIM)
    assert not terminated.any()
    assert not truncated.any()
    best = sum(w for w in asdict(RewardConfig()).values() if w > 0) * 0.02
    assert torch.all(reward > 0.5 * best)
    assert torch.all(reward <= best)


def test_looking_twice_shows_the_same(env):
    first = env.get_observations()["policy"].clone()
    assert torch.equal(first, env.observation_manager.compute()["policy"])


def test_a_robot_that_falls_starts_anew(env):
    env.reset()
    robot = env.scene["robot"]
    state = torch.zeros(1, 13)
    state[0, :3] = env.scene.env_origins[1] + torch.tensor([0.0, 0.0, 0.6])
    state[0, 3:7] = torch.tensor([0.5, 0.0, 0.866, 0.0])  # on its face
    robot.write_root_state_to_sim(state, env_ids=torch.tensor([1]))
    _, _, terminated, _, _ = env.step(torch.zeros(N, ACTIONS))
    assert terminated.tolist() == [False, True, False]
    assert robot.data.root_link_pos_w[1, 2] == pytest.approx(0.74, abs=0.05)
    for _ in range(5):
        _, _, terminated, _, _ = env.step(torch.zeros(N, ACTIONS))
    assert not terminated.any()


def test_a_checkpoint_comes_with_the_controllers_file(env, task_module, tmp_path):
    from mjlab.rl import RslRlVecEnvWrapper

    from egovcp.robot.controllers import make_controller
    from egovcp_train.lowlevel.mjlab_terms import logic_term

    def runner() -> object:
        cfg = task_module.rl_cfg()
        cfg.num_steps_per_env = 4
        return task_module.LowLevelRunner(
            RslRlVecEnvWrapper(env), asdict(cfg), str(tmp_path), "cpu"
        )

    first = runner()
    first.learn(1)
    logic = logic_term(env).logic
    logic.difficulty = 0.5
    first.save(str(tmp_path / "model_1.pt"))
    logic.difficulty = 0.0
    runner().load(str(tmp_path / "model_1.pt"))
    assert logic.difficulty == 0.5
    controller = make_controller(str(tmp_path / "model_1.safetensors"))
    assert controller.walks
