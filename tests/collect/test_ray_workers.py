"""Collection on a local Ray cluster."""

from pathlib import Path

import pytest

from egovcp_collect.collect import main
from egovcp_collect.ray_workers import RayWorker

ray = pytest.importorskip("ray")

_SHORT = (
    "--task=ball",
    "--env.controller=stance",
    "--env.ball_episode.ticks=6",
    "--env.ball_episode.event_ticks=[0,1]",
    "--episodes=5",
)


@pytest.mark.slow
def test_ray_gives_the_same_data(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    assert main([*_SHORT, f"--dataset.root={here}", "--num_workers=1"]) == 0
    ray = ["--backend=ray", "--num_workers=2", "--num_envs=2"]
    assert main([*_SHORT, f"--dataset.root={there}", *ray]) == 0
    for path in here.rglob("*.parquet"):
        assert (there / path.relative_to(here)).read_bytes() == path.read_bytes()


def test_a_failure_to_end_an_actor_is_not_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray raises when its own connection is gone."""

    def refuse(actor: object) -> None:
        raise ray.exceptions.RaySystemError("the connection is gone")

    worker = object.__new__(RayWorker)
    worker._ray, worker._actor = ray, None
    monkeypatch.setattr(ray, "kill", refuse)
    worker.call = object()
    worker.kill()
    assert worker.call is None


def test_an_unreachable_cluster_is_an_environment_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "nonsense://nowhere")
    assert main([*_SHORT, f"--dataset.root={tmp_path / 'd'}", "--backend=ray"]) == 5
    assert "RAY_ADDRESS" in capsys.readouterr().err
    assert not (tmp_path / "d").exists()
