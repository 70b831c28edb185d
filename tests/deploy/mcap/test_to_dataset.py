"""Conversion of recordings to a dataset and back."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egovcp import packages
from egovcp.checks.dataset import dataset_problems
from egovcp.data import DatasetReader, open_dataset
from egovcp.errors import DataError
from egovcp.log.mcap_reader import read_recording
from egovcp.log.tick import Tick
from egovcp.rollouts import CONTROLLER, planned_ticks
from egovcp_collect.dataset.viz import write_recording
from egovcp_deploy.mcap.cli import main

from .conftest import INFO, Record


def test_episode_to_recording_to_episode_is_the_identity(
    dataset: DatasetReader, tmp_path: Path
) -> None:
    files = [str(tmp_path / f"{index}.mcap") for index in range(len(dataset))]
    for index, file in enumerate(files):
        write_recording(dataset, index, Path(file))
    assert main(["to-dataset", *files, f"--dataset.root={tmp_path / 'back'}"]) == 0
    back = open_dataset(tmp_path / "back")
    assert list(dataset_problems(back.root)) == []
    assert (back.controller_id, back.origin.origin) == (dataset.controller_id, "recorded")
    assert back.provenance["config"] == dataset.provenance["config"]
    for index in range(len(dataset)):
        before, after = dataset.read(index), back.read(index)
        absent = {name: np.zeros_like(getattr(before, name)) for name in ("object", "reward_terms")}
        assert replace(before, **absent).digest() == after.digest()  # not in recordings
        assert (before.task, before.time_limit) == (after.task, after.time_limit)
        assert before.metadata == after.metadata


def test_rows_have_the_sent_actions(record: Record, tmp_path: Path) -> None:
    planned = np.full(7, 0.9, np.float32)
    file = record(keep=lambda tick: replace(tick, action_planned=planned))
    assert main(["to-dataset", str(file), f"--dataset.root={tmp_path / 'new'}"]) == 0
    episode = open_dataset(tmp_path / "new").read(0)
    assert not np.isclose(episode.action, 0.9).all(axis=1).any()
    assert episode.done.tolist() == [False] * 7 + [True]
    assert episode.truncated[-1]
    assert list(dataset_problems(tmp_path / "new")) == []


def test_ticks_after_a_fall_are_dropped(
    record: Record, fallen: Callable[[Tick], Tick], tmp_path: Path
) -> None:
    info = replace(INFO, config={"env": {"ball_episode": {"ticks": 40}}})
    file = record(info=info, keep=fallen)
    assert main(["to-dataset", str(file), f"--dataset.root={tmp_path / 'new'}"]) == 0
    episode = open_dataset(tmp_path / "new").read(0)
    assert (len(episode), episode.terminated, episode.time_limit) == (6, True, 40)


@pytest.mark.parametrize(
    "config", [{"time_limit": "soon"}, {"env": {"ball_episode": []}}, {"env": [], "seed": 1}]
)
def test_a_time_limit_that_is_no_number_is_refused(config: dict[str, object]) -> None:
    with pytest.raises(DataError, match=r"its configuration is damaged: (time_limit|env)"):
        planned_ticks(replace(INFO, config=config))


def test_rollouts_of_one_scenario_are_different_episodes(record: Record, tmp_path: Path) -> None:
    files = [str(record(f"{n}.mcap", number=n)) for n in range(2)]
    assert main(["to-dataset", *files, f"--dataset.root={tmp_path / 'new'}"]) == 0
    reader = open_dataset(tmp_path / "new")
    assert reader.identity(0) != reader.identity(1)
    assert reader.metadata(0)["rollout"]["seed"] == INFO.seed


def test_a_rollout_of_any_task_becomes_an_episode_of_it(record: Record, tmp_path: Path) -> None:
    file = record(info=replace(INFO, task="juggle"))
    assert main(["to-dataset", str(file), f"--dataset.root={tmp_path / 'new'}"]) == 0
    assert open_dataset(tmp_path / "new").read(0).task == "juggle"


def test_a_rollout_without_a_task_becomes_an_episode_of_an_unknown_one(
    record: Record, tmp_path: Path
) -> None:
    file = record(info=replace(INFO, task=""))
    assert main(["to-dataset", str(file), f"--dataset.root={tmp_path / 'new'}"]) == 0
    assert open_dataset(tmp_path / "new").task(0) == "unknown"


def test_different_controllers_are_refused(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = replace(INFO, hashes={CONTROLLER: "walk-2"})
    files = [str(record()), str(record("b.mcap", info=other))]
    assert main(["to-dataset", *files, f"--dataset.root={tmp_path / 'new'}"]) == 3
    assert "walk-2" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_missing_ticks_are_refused_or_cut(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, flag = str(record(missing=(5, 6))), f"--dataset.root={tmp_path / 'new'}"
    assert main(["to-dataset", file, flag]) == 3
    assert "2 ticks are missing after tick 4" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    command = ["to-dataset", file, flag, "--gaps=cut"]
    assert main(command) == 0
    assert "cut: 2 ticks are missing after tick 4" in capsys.readouterr().out
    reader = open_dataset(tmp_path / "new")
    assert reader.provenance["command"] == shlex.join(["egovcp-mcap", *command])
    episode = reader.read(0)
    assert (len(episode), bool(episode.truncated[-1]), episode.time_limit) == (5, True, 5)
    assert list(dataset_problems(tmp_path / "new")) == []


def test_a_pause_is_a_gap(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = 40_000_000
    file = record(keep=lambda t: replace(t, time_ns=t.time_ns + (late if t.index > 2 else 0)))
    assert main(["to-dataset", str(file), f"--dataset.root={tmp_path / 'new'}"]) == 3
    assert "paused after tick 2" in capsys.readouterr().err
    assert main(["info", str(file), "--json=-"]) == 0
    gaps = json.loads(capsys.readouterr().out)["gaps"]
    assert gaps == [{"after": 2, "missing": 0, "seconds": 0.08}]


@pytest.mark.parametrize(
    ("info", "words"),
    [
        (replace(INFO, hashes={}), "does not say which low-level controller"),
    ],
)
def test_missing_run_information_is_refused(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str], info: object, words: str
) -> None:
    file = record(info=info)
    assert main(["to-dataset", str(file), f"--dataset.root={tmp_path / 'new'}"]) == 3
    assert words in capsys.readouterr().err


def test_values_out_of_range_are_refused(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = record(keep=lambda tick: replace(tick, state=tick.state * np.nan))
    assert main(["to-dataset", str(file), f"--dataset.root={tmp_path / 'new'}"]) == 3
    assert "state is not finite" in capsys.readouterr().err


def test_the_dataset_can_be_trained_on(record: Record, tmp_path: Path) -> None:
    from egovcp_train.train import main as train

    files = [str(record(f"{n}.mcap", number=n)) for n in range(3)]
    assert main(["to-dataset", *files, f"--dataset.root={tmp_path / 'new'}"]) == 0
    flags = ["--preset=debug", "--steps=2", "--batch_size=2", f"--output_dir={tmp_path / 'run'}"]
    flags += ["--returns.steps=4", "--sampling.length=6"]
    assert train([f"--dataset.root={tmp_path / 'new'}", *flags]) == 0
    assert (tmp_path / "run/checkpoints/last/pretrained_model/model.safetensors").is_file()


def test_a_missing_package_is_named_before_anything_is_written(
    record: Record,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = record()
    monkeypatch.setattr(packages, "is_installed", lambda name: name != "pandas")
    assert main(["to-dataset", str(file), f"--dataset.root={tmp_path / 'new'}"]) == 5
    message = "writing a dataset needs pandas, which is not installed"
    assert message in capsys.readouterr().err
    assert [path for path in tmp_path.iterdir() if "new" in path.name] == []


def live(tick: Tick) -> Tick:
    modes = ["init", "stand", "armed", "run", "hold", "run", "damp", "damp"]
    events = ("armed -> run: the operator asked for it",) if tick.index == 3 else ()
    return replace(tick, mode=modes[tick.index], events=events)


def test_a_live_run_is_reduced_to_its_ticks_in_run(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record(keep=live)
    assert main(["to-dataset", str(path), f"--dataset.root={tmp_path / 'out'}"]) == 0
    assert "torn" not in capsys.readouterr().out
    episode = open_dataset(tmp_path / "out").read(0)
    ticks = read_recording(path).ticks[3:6]
    np.testing.assert_array_equal(episode.action, [tick.action_sent for tick in ticks])
    assert episode.truncated.tolist() == [False, False, True]


@pytest.mark.parametrize("missing", [(0, 1), (2, 3)])
def test_a_run_whose_beginning_is_missing_is_refused(
    missing: tuple[int, ...], record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record(missing=missing, keep=live if 3 in missing else lambda tick: tick)
    for gaps in ("refuse", "cut"):
        flags = [f"--dataset.root={tmp_path / 'out'}", f"--gaps={gaps}"]
        assert main(["to-dataset", str(path), *flags]) == 3
        assert "its first ticks are missing" in capsys.readouterr().err


def test_the_same_rollout_twice_is_refused_and_nothing_remains(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = record()
    copy, recovered = tmp_path / "copy.mcap", tmp_path / "recovered.mcap"
    copy.write_bytes(file.read_bytes())
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    assert main(["recover", str(torn), str(recovered)]) == 0
    for other in (file, copy, recovered):
        different = record(f"other-{other.stem}.mcap", number=1)
        capsys.readouterr()
        call = ["to-dataset", str(file), str(different), str(other)]
        assert main([*call, f"--dataset.root={tmp_path / 'new'}"]) == 3
        assert f"{other} repeats {file}" in capsys.readouterr().err
        assert not [path for path in tmp_path.iterdir() if "new" in path.name]


@pytest.mark.parametrize("is_there", [True, False])
def test_a_link_as_destination_is_followed(is_there: bool, record: Record, tmp_path: Path) -> None:
    link, real = tmp_path / "link", tmp_path / "real"
    link.symlink_to(real)
    if is_there:
        real.mkdir()
    assert main(["to-dataset", str(record()), f"--dataset.root={link}"]) == 0
    assert link.is_symlink()
    assert len(open_dataset(real)) == 1


def test_a_mount_point_is_refused(
    record: Record, mount_point: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["to-dataset", str(record()), f"--dataset.root={mount_point}"]) == 5
    assert f"{mount_point} is a mount point" in capsys.readouterr().err
    assert not list(mount_point.iterdir())
