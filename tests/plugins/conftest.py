"""A tiny dataset, an artifact of egovcp-train, and LeRobot's view of both."""

from pathlib import Path

import pytest
from lerobot.datasets import LeRobotDatasetMetadata

from egovcp.data import DatasetWriter, Provenance, ReturnConfig
from egovcp.model import WorldModelConfig
from egovcp.plan import PlannerConfig
from egovcp.robot.stance import StanceController
from egovcp.testing import random_episode
from egovcp_train.train import main as egovcp_train
from lerobot_policy_egovcp import EgovcpConfig

CONTROLLER = StanceController().id
REPO_ID = "me/ball"
RETURNS = ReturnConfig(steps=4)


@pytest.fixture(scope="session")
def dataset_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight episodes of 12 ticks, the third of which ends in a fall; tests must not change it."""
    root = tmp_path_factory.mktemp("plugins") / "dataset"
    with DatasetWriter(root, Provenance(CONTROLLER, seed=0, command="collect")) as writer:
        for number in range(8):
            writer.add(random_episode(number, 9 if number == 2 else 12, 12))
    return root


@pytest.fixture
def meta(dataset_root: Path) -> LeRobotDatasetMetadata:
    """What LeRobot knows of the dataset."""
    return LeRobotDatasetMetadata(REPO_ID, root=dataset_root)


@pytest.fixture(scope="session")
def artifact(dataset_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What egovcp-train writes; tests must not change it."""
    output = tmp_path_factory.mktemp("artifact") / "run"
    options = {
        "output_dir": output,
        "dataset.root": dataset_root,
        "preset": "debug",
        "steps": 3,
        "batch_size": 2,
        "sampling.length": 6,
        "returns.steps": RETURNS.steps,
        "planner.samples": 16,
        "planner.elites": 4,
        "tensorboard": "false",
        "threads": 1,
        "device": "cpu",
    }
    assert egovcp_train([f"--{name}={value}" for name, value in options.items()]) == 0
    return output / "checkpoints" / "last" / "pretrained_model"


@pytest.fixture
def config() -> EgovcpConfig:
    """A policy to train from scratch, of debug size."""
    return EgovcpConfig(
        device="cpu",
        push_to_hub=False,
        world_model=WorldModelConfig(32, 8, 32, (4, 8, 8)),
        planner=PlannerConfig(samples=16, elites=4),
        returns=RETURNS,
        sequence_length=6,
    )
