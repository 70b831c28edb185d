"""Training streamed from the Hub: pinned commit, resume, network errors."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from egovcp.artifact import load_artifact
from egovcp.data import DatasetReader, DatasetWriter, Provenance
from egovcp.data.source import lerobot_home
from egovcp.dataset_options import DatasetConfig
from egovcp.hub import Content, Publication, RetryPolicy, publish
from egovcp.model import Batch
from egovcp_train.checkpoint import load_training_state
from egovcp_train.loop import Learner
from egovcp_train.train import main
from tests.support.arguments import Arguments
from tests.support.hub import FakeHub

CONTROLLER = "stance-test"
QUICK = RetryPolicy(attempts=2, wait_s=0.01, timeout_s=20)


def _publish(root: Path) -> str:
    files = [path for path in root.rglob("*") if path.is_file()]
    contents = {path.relative_to(root).as_posix(): Content(path) for path in files}
    return publish(Publication("me/ball", contents, "episodes"), QUICK).commit


@pytest.fixture(scope="module")
def many_files(dataset_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The eight episodes, each in a file of its own."""
    root = tmp_path_factory.mktemp("streaming") / "dataset"
    source = DatasetReader.open(DatasetConfig(root=str(dataset_root)))
    with DatasetWriter(root, Provenance(CONTROLLER, seed=0), shard_episodes=1) as writer:
        for episode in source:
            writer.add(episode)
    return root


@pytest.fixture
def commit(hub: FakeHub, many_files: Path) -> str:
    made = _publish(many_files)
    hub.reset()
    return made


@pytest.fixture
def streamed(arguments: Arguments, commit: str) -> Arguments:
    """Flags of a run on `me/ball`, two episodes in memory."""

    def build(output: Path, *flags: str, **options: object) -> list[str]:
        return arguments(
            output,
            *flags,
            dataset__root=None,
            dataset__repo_id="me/ball",
            loading__mode="stream",
            loading__shuffle__episodes=2,
            loading__sample_files=1,
            loading__network__attempts=2,
            loading__network__wait_s=0.01,
            **options,
        )

    return build


@pytest.fixture
def no_prefetch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files come only when they are read, so that which ones are here depends on no timing."""
    monkeypatch.setattr("egovcp.hub.file_cache.PREFETCH_FILES", 0)


def _data_files(hub_home: Path) -> int:
    return len(list(hub_home.rglob("snapshots/*/data/**/*.parquet")))


def _artifact(output: Path) -> Any:
    return load_artifact(str(output / "checkpoints" / "last" / "pretrained_model"))


@pytest.mark.usefixtures("no_prefetch")
def test_training_starts_before_the_download_ends_and_keeps_its_commit(
    streamed: Arguments, many_files: Path, commit: str, tmp_path: Path
) -> None:
    assert main(streamed(tmp_path / "run", steps=1)) == 0
    assert 0 < _data_files(lerobot_home()) < 8
    manifest = _artifact(tmp_path / "run").manifest
    assert manifest["datasets"] == [{"repo_id": "me/ball", "revision": commit, "episodes": ""}]
    assert manifest["heldout_episodes"]["count"] == 1

    other = shutil.copytree(many_files, tmp_path / "other")
    (other / "README.md").write_text("a newer version")
    assert _publish(other) != commit
    assert main([f"--output_dir={tmp_path / 'run'}", "--resume", "--steps=2"]) == 0
    assert _artifact(tmp_path / "run").manifest["datasets"][0]["revision"] == commit


def test_the_batches_and_the_state_statistics_are_those_of_a_local_copy(
    streamed: Arguments, arguments: Arguments, many_files: Path, tmp_path: Path
) -> None:
    assert main(streamed(tmp_path / "streamed", steps=3)) == 0
    window = {"loading__mode": "stream", "loading__shuffle__episodes": 2}
    assert main(arguments(tmp_path / "disk", dataset__root=many_files, steps=3, **window)) == 0
    streams = [load_training_state(tmp_path / name)["stream"] for name in ("streamed", "disk")]
    assert streams[0] == streams[1]
    models = [_artifact(tmp_path / name).world_model.state_dict() for name in ("streamed", "disk")]
    for name in ("state_mean", "state_std"):
        torch.testing.assert_close(models[0][name], models[1][name])


@pytest.mark.slow
@pytest.mark.usefixtures("no_prefetch")
def test_a_lost_network_ends_the_run_and_a_resumed_one_goes_on_with_the_next_batch(
    streamed: Arguments,
    hub: FakeHub,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    update = Learner.update

    def cut_off(self: Learner, batch: Batch, progress: float) -> dict[str, torch.Tensor]:
        if self.step == 3:
            hub.fail("*", "reset")
        return update(self, batch, progress)

    lost = tmp_path / "lost"
    with monkeypatch.context() as patched:
        patched.setattr(Learner, "update", cut_off)
        assert main(streamed(lost, steps=20)) == 5
    assert "the Hub cannot be used" in capsys.readouterr().err.splitlines()[-1]
    assert 3 <= load_training_state(lost)["learner"]["step"] < 20
    hub.reset()
    assert main([f"--output_dir={lost}", "--resume"]) == 0

    assert main(streamed(tmp_path / "straight", steps=20)) == 0
    one, two = (load_training_state(tmp_path / name) for name in ("lost", "straight"))
    assert one["stream"] == two["stream"]
    for name, weight in one["learner"]["model"].items():
        assert torch.equal(weight, two["learner"]["model"][name])


@pytest.mark.parametrize(
    ("repo_id", "status", "code", "message"),
    [("me/none", 0, 3, "no dataset me/none"), ("me/ball", 403, 5, "read access")],
)
def test_an_unreadable_dataset_is_refused_before_output_is_written(
    streamed: Arguments,
    hub: FakeHub,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    repo_id: str,
    status: int,
    code: int,
    message: str,
) -> None:
    if status:
        hub.fail("*", status)
    assert main(streamed(tmp_path / "run", f"--dataset.repo_id={repo_id}")) == code
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "run").exists()


def test_a_damaged_file_found_during_training_ends_the_run(
    streamed: Arguments, many_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An episode of the Hub is validated when it is first read."""
    bad = shutil.copytree(many_files, tmp_path / "bad")
    files = sorted((bad / "data").rglob("*.parquet"))
    for path in files[1:]:
        path.write_bytes(files[0].read_bytes())
    _publish(bad)
    assert main(streamed(tmp_path / "run", steps=20)) == 3
    assert "column index is " in capsys.readouterr().err.splitlines()[-1]


def test_only_the_episodes_asked_for_are_trained_on_and_named(
    arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments(tmp_path / "run", dataset__episodes="[0:3, 5]")) == 0
    artifact = _artifact(tmp_path / "run")
    assert artifact.manifest["datasets"][0]["episodes"] == "[0:3, 5]"
    (numbers,) = artifact.manifest["heldout_episodes"]["numbers"]
    assert set(numbers) < {0, 1, 2, 5}
    assert main([f"--output_dir={tmp_path / 'run'}", "--resume", "--steps=7"]) == 0

    assert main(arguments(tmp_path / "other", dataset__episodes="0:9")) == 2
    assert "has 8 episodes, 0 to 7" in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "other").exists()
