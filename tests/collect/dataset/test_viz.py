"""`egovcp-dataset viz`: an episode as a Rerun recording."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.experimental import RrdReader

from egovcp import packages, spec
from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, Provenance
from egovcp.data.source import lerobot_home
from egovcp.errors import DataError
from egovcp.hub import Content, Publication, RetryPolicy, publish
from egovcp.log import paths
from egovcp.robot.kinematics import LINK_NAMES
from egovcp.rollouts import camera_view, recording_info, ticks_of
from egovcp.sim.config import EnvConfig
from egovcp.testing import random_episode
from egovcp_collect.dataset import viz
from egovcp_collect.dataset.cli import main
from egovcp_collect.dataset.viz import write_recording
from tests.support.hub import FakeHub

from .conftest import write
from .episodes import ARM, SETTINGS, make_episode, three_balls, write_episodes


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> DatasetReader:
    return write_episodes(tmp_path_factory.mktemp("data") / "three", three_balls())


@pytest.fixture(scope="module")
def store(reader: DatasetReader, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Episode 1, the one that ends in a fall."""
    path = tmp_path_factory.mktemp("rrd") / "new" / "one.rrd"
    write_recording(reader, 1, path, meshes=False)
    return RrdReader(path).store()


def column(store: Any, path: str, component: str) -> list[Any]:
    """Values of one component over time, in the order of the ticks."""
    rows: list[tuple[int, Any]] = []
    for chunk in store.stream().to_chunks():
        if chunk.entity_path == path and not chunk.is_static:
            batch = chunk.to_record_batch()
            if component in batch.schema.names:
                ticks = batch.column("tick").to_pylist()
                rows += zip(ticks, batch.column(component).to_pylist(), strict=True)
    return [value for _, value in sorted(rows)]


def test_every_part_of_a_row_has_an_entity(store: Any) -> None:
    found = set(store.schema().entity_paths())
    expected = {paths.DEPTH, paths.CAMERA, paths.HAND_TARGETS, paths.SKELETON, paths.INFO}
    expected |= {f"{paths.ROBOT}/{link}" for link in LINK_NAMES}
    expected |= {f"{paths.REWARD}/total", paths.OUTCOME, paths.EVENTS}
    expected |= {f"{paths.ACTION}/{part}" for part in ("left_hand", "right_hand", "height")}
    expected |= {f"{paths.STATE}/projected_gravity", f"{paths.STATE}/joint_position/left_arm"}
    assert expected <= found


def test_rows_are_recorded_unchanged(store: Any, reader: DatasetReader) -> None:
    episode = reader.read(1)
    images = column(store, paths.DEPTH, "DepthImage:buffer")
    assert len(images) == len(episode)
    depth = np.array([np.asarray(i[0], np.uint8).view(np.uint16) for i in images])
    np.testing.assert_array_equal(depth.reshape(episode.depth.shape), episode.depth)
    scalars = "Scalars:scalars"
    np.testing.assert_allclose(
        column(store, f"{paths.ACTION}/normalised", scalars), episode.action, atol=1e-6
    )
    metric = spec.ACTION_BOX.to_metric(episode.action)
    right = column(store, f"{paths.ACTION}/right_hand", scalars)
    np.testing.assert_allclose(right, metric[:, 3:6], atol=1e-6)
    reward = np.ravel(column(store, f"{paths.REWARD}/total", scalars))
    np.testing.assert_allclose(reward, episode.reward)
    outcome = np.array(column(store, paths.OUTCOME, scalars))
    np.testing.assert_array_equal(outcome[:, 0], episode.done)
    np.testing.assert_array_equal(outcome[:, 1], episode.success)


def test_the_pelvis_stands_at_its_commanded_height(store: Any) -> None:
    (translation,) = column(store, f"{paths.ROBOT}/{LINK_NAMES[0]}", "Transform3D:translation")[3]
    np.testing.assert_allclose(translation, [0.0, 0.0, 0.7], atol=1e-6)


def test_events_are_recorded(reader: DatasetReader) -> None:
    ticks = [*ticks_of(reader.read(1))]
    assert ticks[20].events == ("the event of the task",)
    assert ticks[40].events == ("reward -1.000", "a fall ends the episode")
    assert ticks[40].terminated
    assert not ticks[40].truncated
    assert [*ticks_of(reader.read(2))][-1].events == ("the episode is truncated",)
    assert ticks[2].time_ns == 2 * 40_000_000


def test_the_camera_has_the_pose_of_the_episode() -> None:
    view = camera_view(SETTINGS.config, {"camera_pitch": 0.05})
    assert view.pitch == 0.05
    assert view.position == (0.058, 0.0, 0.42)


def test_a_camera_that_is_not_recorded_is_the_simulated_one() -> None:
    view, simulated = camera_view({}, {"camera_pitch": None}), EnvConfig().camera
    assert (view.position, view.vertical_fov) == (simulated.position, simulated.vertical_fov)
    assert simulated.pitch_range[0] < view.pitch < simulated.pitch_range[1]


@pytest.mark.parametrize(
    ("camera", "facts", "message"),
    [
        ({"position": [1, 2]}, {}, r"camera\.position"),
        ({"vertical_fov": 0}, {}, "vertical_fov=0"),
        ({"vertical_fov": None}, {}, r"camera\.vertical_fov"),
        ({}, {"episode": 1.5}, "episode"),
        ({}, {"seed": "x"}, "seed"),
    ],
)
def test_damaged_facts_are_a_data_error_of_their_file(
    reader: DatasetReader,
    monkeypatch: pytest.MonkeyPatch,
    camera: dict[str, object],
    facts: dict[str, object],
    message: str,
) -> None:
    known = {"config": {"env": {"camera": camera}}}
    monkeypatch.setattr(DatasetReader, "provenance", known)
    with pytest.raises(DataError, match=rf"collection\.json, episode 1: .*{message}"):
        recording_info(reader, 1, replace(reader.read(1), metadata=facts))


def test_facts_that_are_null_are_unknown(reader: DatasetReader) -> None:
    facts = {"episode": None, "seed": None, "camera_pitch": None}
    info = recording_info(reader, 1, replace(reader.read(1), metadata=facts))
    assert (info.seed, info.episode) == (0, 1)


def test_the_command_names_the_file_after_dataset_and_episode(
    reader: DatasetReader,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["viz", str(reader.root), "--episode=2"]) == 0
    out = capsys.readouterr().out
    assert "three-episode-2.rrd" in out
    assert "pelvis pose is not recorded" in out
    assert [p.name for p in tmp_path.iterdir()] == ["three-episode-2.rrd"]
    assert main(["viz", str(reader.root), "--episode=2"]) == 5
    assert "exists already" in capsys.readouterr().err


def test_no_pose_is_mentioned_of_another_robot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "arm"
    with DatasetWriter(root, Provenance("arm-1")) as writer:
        writer.add(random_episode(0, robot=ARM))
    assert main(["viz", str(root), f"--output={tmp_path / 'arm.rrd'}"]) == 0
    assert "pelvis" not in capsys.readouterr().out
    reader = DatasetReader.open(DatasetConfig(root=str(root)))
    assert "pose" not in recording_info(reader, 0, reader.read(0)).config


def test_mcap_of_a_dataset_of_another_origin_is_refused(
    others: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "arm.mcap"
    assert main(["viz", str(others["arm"]), f"--output={output}"]) == 2
    assert "MCAP needs a dataset that egovcp collected" in capsys.readouterr().err
    assert not output.exists()


def test_of_a_dataset_on_the_hub_only_the_file_of_the_episode_is_downloaded(
    hub: FakeHub, tmp_path: Path
) -> None:
    root = write(tmp_path / "six", [*range(6)])
    assert main(["push", str(root), "--repo_id=me/six"]) == 0
    output = tmp_path / "me.rrd"
    assert main(["viz", "me/six", "--episode=4", f"--output={output}"]) == 0
    assert output.is_file()
    assert [p.name for p in lerobot_home().rglob("file-*") if "data" in p.parts] == [
        "file-001.parquet"
    ]


def test_a_dataset_of_another_origin_on_the_hub_is_shown(
    hub: FakeHub, others: dict[str, Path], tmp_path: Path
) -> None:
    files = [path for path in others["arm"].rglob("*") if path.is_file()]
    contents = {path.relative_to(others["arm"]).as_posix(): Content(path) for path in files}
    publish(Publication("me/arm", contents, "an arm"), RetryPolicy(attempts=2))
    output = tmp_path / "arm.rrd"
    assert main(["viz", "me/arm", f"--output={output}"]) == 0
    assert output.is_file()


@pytest.mark.parametrize("episode", [-1, 3])
def test_a_missing_episode_is_a_usage_error(
    reader: DatasetReader, episode: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["viz", str(reader.root), f"--episode={episode}"]) == 2
    assert "has episodes 0 to 2" in capsys.readouterr().err


def test_spawn_opens_a_viewer_that_only_this_machine_can_reach(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader = write_episodes(tmp_path / "one", [make_episode(0, length=3, time_limit=3)])
    started: list[list[str]] = []
    monkeypatch.setattr(viz.subprocess, "Popen", lambda args, **options: started.append(args))
    output = tmp_path / "a.rrd"
    assert main(["viz", str(reader.root), f"--output={output}", "--spawn"]) == 0
    (command,) = started
    assert command[-3:] == ["--bind", "127.0.0.1", str(output)]
    assert output.is_file()


def test_a_missing_rerun_is_an_environment_failure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(packages, "is_installed", lambda name: name != "rerun")
    assert main(["viz", "--dataset.root=anything"]) == 5
    assert "egovcp-collect[viz]" in capsys.readouterr().err
