"""A folder with everything that the documented commands read, in small."""

from __future__ import annotations

import shutil
from pathlib import Path

import draccus
import pytest

from egovcp.artifact import save_artifact
from egovcp.data import DatasetWriter, Provenance, open_dataset
from egovcp.plan import PlannerConfig
from egovcp.robot.controllers import WALK, make_controller
from egovcp.testing import random_episode, toy_model
from egovcp_collect.config import CollectConfig
from egovcp_collect.dataset.viz import write_recording

ROOT = Path(__file__).resolve().parents[2]
EPISODES = 4
TICKS = 52
#: Datasets and the task of their episodes.
DATASETS = {
    "data/ball": "ball",
    "data/wall": "wall",
    "data/arch": "arch",
    "data/contact": "ball",
    "data/both": "ball",
    "data/rollouts": "ball",
    "outputs/cards/ball": "ball",
}
#: Runs of egovcp-train.
RUNS = (
    "runs/contact",
    *("runs/ball", "runs/wall", "runs/arch", "runs/all", "runs/lerobot"),
    *("outputs/quickstart/policy", "outputs/experiments/work/train-wall-default-s0"),
)
_PLANNER = PlannerConfig(samples=16, horizon=3, iterations=2, elites=4, eta=0.02)


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder; tests must not change it."""
    folder = tmp_path_factory.mktemp("documented")
    controller = make_controller(WALK).id
    for seed, (name, task) in enumerate(DATASETS.items()):
        provenance = Provenance(
            controller, seed, "egovcp-collect", config=draccus.encode(CollectConfig(task=task))
        )
        with DatasetWriter(folder / name, provenance) as writer:
            for number in range(EPISODES):
                writer.add(random_episode(number, TICKS, task=task, seed=seed))
    artifact = folder / "artifact"
    save_artifact(artifact, toy_model(), _PLANNER, {"controller_id": controller})
    for name in RUNS:
        policy = folder / name / "checkpoints" / "last" / "pretrained_model"
        shutil.copytree(artifact, policy)
    recording = folder / "rollout-0.mcap"
    write_recording(open_dataset(folder / "data" / "ball"), 0, recording)
    for copy in ("live/rollout-0.mcap", "runs/ball/rollout-0.mcap", "torn.mcap"):
        (folder / copy).parent.mkdir(exist_ok=True)
        shutil.copy(recording, folder / copy)
    shutil.copy(ROOT / "egovcp" / "robot" / "g1_walk.safetensors", folder / "walk.safetensors")
    return folder
