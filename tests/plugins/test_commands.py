"""``lerobot-train`` and ``lerobot-eval`` find the plugins, train, publish and play a policy."""

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import HfApi

from egovcp import spec
from egovcp.artifact import load_artifact
from egovcp.checks import check_artifact
from egovcp.data.camera_images import decode_frames
from egovcp.manifest import PROCESSORS
from egovcp.robot.stance import StanceController
from lerobot_policy_egovcp import EgovcpPolicy
from tests.support.hub import FakeHub, hub_environment, redirect_hub

PLUGINS = sorted((Path(__file__).resolve().parents[2] / "plugins").iterdir())
POLICY = "me/policy"
TOKEN = "hf_right"


@pytest.fixture(scope="module")
def hub(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeHub]:
    """A Hub that knows one user."""
    with FakeHub(tmp_path_factory.mktemp("hub"), token=TOKEN) as hub:
        yield hub


@pytest.fixture(scope="module")
def surroundings(hub: FakeHub, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment in which the plugins' distributions are installed, with a Hub of its own."""
    place = tmp_path_factory.mktemp("site")
    for plugin in PLUGINS:
        project = tomllib.loads((plugin / "pyproject.toml").read_text())["project"]
        name, version = project["name"], project["version"]
        note = place / f"{name}-{version}.dist-info" / "METADATA"
        note.parent.mkdir()
        note.write_text(f"Metadata-Version: 2.3\nName: {name}\nVersion: {version}\n")
    paths = [str(place), *map(str, PLUGINS), os.environ.get("PYTHONPATH", "")]
    own = {"PYTHONPATH": os.pathsep.join(filter(None, paths)), "HF_TOKEN": TOKEN}
    return os.environ | hub_environment(hub.endpoint, place) | own


def _run(surroundings: dict[str, str], program: str, *options: str) -> str:
    """The log of ``lerobot-train`` or ``lerobot-eval`` with these options."""
    start = (
        "from huggingface_hub import RepoCard\n"
        "RepoCard.validate = lambda self, repo_type=None: None\n"  # it asks the real Hub
        f"from lerobot.scripts.lerobot_{program} import main\n"
        "main()"
    )
    command = [sys.executable, "-c", start, *options]
    done = subprocess.run(
        command, env=surroundings, capture_output=True, text=True, timeout=280, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout + done.stderr


def _checkpoint(output: Path, step: int) -> Path:
    return output / "checkpoints" / f"{step:06d}" / "pretrained_model"


@pytest.fixture(scope="module")
def run(
    surroundings: dict[str, str], dataset_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str]:
    """Two steps from scratch, published: the output folder, and the log."""
    output = tmp_path_factory.mktemp("lerobot-train") / "run"
    small = {"hidden": 32, "latent": 8, "units": 32, "channels": "[4,8,8]"}
    log = _run(
        surroundings,
        "train",
        "--policy.type=egovcp",
        "--policy.device=cpu",
        "--policy.push_to_hub=true",
        f"--policy.repo_id={POLICY}",
        "--policy.private=true",
        "--policy.sequence_length=6",
        "--policy.returns.steps=4",
        "--policy.planner.samples=16",
        "--policy.planner.elites=4",
        *(f"--policy.world_model.{name}={value}" for name, value in small.items()),
        "--dataset.repo_id=me/ball",
        f"--dataset.root={dataset_root}",
        f"--output_dir={output}",
        "--steps=2",
        "--batch_size=4",
        "--num_workers=0",
        "--log_freq=1",
    )
    return output, log


@pytest.mark.slow
def test_it_trains_a_policy_that_egovcp_and_lerobot_load(run: tuple[Path, str]) -> None:
    output, log = run
    assert re.search(r"step:2 .*kl_prior:", log)
    artifact = check_artifact(str(_checkpoint(output, 2)))
    assert artifact.controller_id == StanceController().id
    assert "--policy.type=egovcp" in artifact.manifest["command"]
    policy = EgovcpPolicy.from_pretrained(_checkpoint(output, 2))
    assert policy.config.planner == artifact.planner
    assert policy.config.planner.samples == 16


@pytest.mark.slow
def test_what_it_publishes_is_the_artifact(
    hub: FakeHub, run: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeRobot adds its options and the processors, which the manifest does not seal."""
    output, log = run
    assert re.search(rf"Model pushed to {hub.endpoint}/\S*{POLICY}", log)
    assert hub.store.refs(f"models/{POLICY}").private
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    with redirect_hub(hub.endpoint, tmp_path):
        check_artifact(POLICY)
        policy = EgovcpPolicy.from_pretrained(POLICY)
        published = HfApi(endpoint=hub.endpoint, token=TOKEN).list_repo_files(POLICY)
    assert {"train_config.json", *PROCESSORS} <= set(published)
    for name, value in load_artifact(str(_checkpoint(output, 2))).world_model.state_dict().items():
        assert policy.world_model.state_dict()[name].equal(value), name


@pytest.mark.slow
def test_a_run_is_resumed(surroundings: dict[str, str], run: tuple[Path, str]) -> None:
    output, _ = run
    options = _checkpoint(output, 2) / "train_config.json"
    log = _run(surroundings, "train", f"--config_path={options}", "--resume=true", "--steps=3")
    assert "Resuming data order at epoch 0, sample 8" in log
    before, after = (
        check_artifact(str(_checkpoint(output, step))).world_model.state_dict() for step in (2, 3)
    )
    assert before.keys() == after.keys()
    assert any(not before[name].equal(after[name]) for name in before)


@pytest.mark.slow
@pytest.mark.usefixtures("run")
def test_lerobot_eval_plays_it_from_the_hub(surroundings: dict[str, str], tmp_path: Path) -> None:
    _run(
        surroundings,
        "eval",
        f"--policy.path={POLICY}",
        "--policy.device=cpu",
        "--policy.save_predicted_video=true",
        "--env.type=egovcp",
        "--env.task=ball",
        "--env.simulation.controller=stance",
        "--env.simulation.ball_episode.ticks=6",
        "--env.simulation.ball_episode.event_ticks=[2,3]",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        f"--output_dir={tmp_path}",
    )
    result = json.loads((tmp_path / "eval_info.json").read_text())
    assert result["overall"]["n_episodes"] == 2
    assert len(list(tmp_path.rglob("eval_episode_*.mp4"))) == 2
    (predicted,) = result["overall"]["predicted_video_paths"]
    frames = decode_frames(Path(predicted), np.arange(6) / spec.PLANNER_HZ)
    assert {(frame.height, frame.width) for frame in frames} == {(4 * 48, 4 * 4 * 64)}
