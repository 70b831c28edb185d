"""Every number that any command takes: its default is allowed, and no number is none."""

from __future__ import annotations

import dataclasses
import importlib
import math
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from egovcp.bounds import check_bounds, check_cores
from egovcp.entry_point import EntryPoint
from egovcp.errors import UsageError

ROOT = Path(__file__).resolve().parents[1]

#: ListedCommand -> the class of its options, of those with numbers among them.
CONFIGS = {
    "egovcp-collect": "egovcp_collect.config:CollectConfig",
    "egovcp-train": "egovcp_train.config:TrainConfig",
    "egovcp-eval-model": "egovcp_train.heldout.command:HeldoutConfig",
    "egovcp-train-lowlevel": "egovcp_train.lowlevel.train:LowLevelTrainConfig",
    "egovcp-eval-lowlevel": "egovcp_train.lowlevel.evaluate:LowLevelEvalConfig",
    "egovcp-train-ppo": "egovcp_train.ppo.train:PpoTrainConfig",
    "egovcp-deploy": "egovcp_deploy.config:DeployConfig",
    "egovcp-demo": "egovcp_deploy.demo:DemoConfig",
    "egovcp-eval": "egovcp_deploy.evaluate:EvalConfig",
    "egovcp-fake-g1": "egovcp_deploy.robots.fake.command:FakeG1Config",
    "egovcp-depth-server": "egovcp_deploy.robots.depth_server:DepthServerConfig",
    "egovcp-experiment": "egovcp_experiment.config:ExperimentConfig",
}
#: Those whose options hold no number, or are looked up by the name of what they shall do.
WITHOUT = {
    "egovcp-push",
    "egovcp-export",
    "egovcp-compare",
    "egovcp-dataset",
    "egovcp-mcap",
    "egovcp-task",
}


def _default(command: str) -> Any:
    module, name = CONFIGS[command].split(":")
    config_class = getattr(importlib.import_module(module), name)
    needed = [f.name for f in dataclasses.fields(config_class) if _has_none(f)]
    return config_class(**dict.fromkeys(needed, "x"))


def _has_none(option: dataclasses.Field[Any]) -> bool:
    return option.default is option.default_factory is dataclasses.MISSING


def _numbers(config: Any) -> Iterator[tuple[str, ...]]:
    """Path of every option that is a number or a row of them."""
    for option in dataclasses.fields(config):
        value = getattr(config, option.name)
        if dataclasses.is_dataclass(value):
            yield from ((option.name, *inner) for inner in _numbers(value))
        elif _is_number(value) or (isinstance(value, tuple) and any(map(_is_number, value))):
            yield (option.name,)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _replaced(config: Any, path: tuple[str, ...], value: object) -> Any:
    """The config with another number there; with it in all places of a row of numbers."""
    name, *inner = path
    old = getattr(config, name)
    if inner:
        return dataclasses.replace(config, **{name: _replaced(old, tuple(inner), value)})
    new = (value,) * len(old) if isinstance(old, tuple) else value
    return dataclasses.replace(config, **{name: new})


def test_every_command_is_known() -> None:
    found: set[str] = set()
    for part in ("collect", "train", "deploy", "experiment"):
        project = tomllib.loads((ROOT / part / "pyproject.toml").read_text(encoding="utf-8"))
        found |= set(project["project"]["scripts"])
    assert found == CONFIGS.keys() | WITHOUT


@pytest.mark.parametrize("command", CONFIGS)
def test_no_number_is_none(command: str) -> None:
    """A limit of a robot that is not a number would never be exceeded."""
    config = _default(command)
    check_bounds(config)
    taken = []
    for path in _numbers(config):
        try:
            check_bounds(_replaced(config, path, math.nan))
        except UsageError:
            continue
        taken.append(".".join(path))
    assert not taken


@pytest.mark.parametrize("command", CONFIGS)
def test_counts_and_seeds_do_not_go_below_zero(command: str) -> None:
    config = _default(command)
    counts = {"episodes", "seed", "steps", "threads", "robots", "num_envs", "num_workers"}
    counts |= {"batch_size", "save_freq", "max_minutes", "jobs", "samples", "horizon"}
    found = [path for path in _numbers(config) if path[-1] in counts]
    assert found or command == "egovcp-depth-server"
    for path in found:
        with pytest.raises(UsageError, match=r"expected (at least|more than)"):
            check_bounds(_replaced(config, path, -1))


# --- what the machine can use ---------------------------------------------------------------
CORES = 3
#: Options whose number is one of threads or processes.
SHARING_CORES = {"threads", "num_workers", "jobs"}


def _run(command: str, *flags: str) -> int:
    """The exit code of a command, called in this process."""
    part = CONFIGS[command].split(".")[0]
    commands = vars(importlib.import_module(f"{part}.commands")).values()
    (entry,) = [c for c in commands if isinstance(c, EntryPoint) and c.prog == command]
    needs = {f.name for f in dataclasses.fields(_default(command))}
    argv = ["planners"] if command == "egovcp-experiment" else []
    argv += ["--output_dir=x"] if "output_dir" in needs else []
    code: int = importlib.import_module(entry.module).main([*argv, *flags])
    return code


def _sharing_cores() -> list[tuple[str, tuple[str, ...]]]:
    paths = [(command, path) for command in CONFIGS for path in _numbers(_default(command))]
    return [(command, path) for command, path in paths if path[-1] in SHARING_CORES]


@pytest.mark.parametrize(("command", "path"), _sharing_cores())
def test_more_threads_or_processes_than_cores_can_share_are_refused(
    command: str,
    path: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("egovcp.bounds.available_cores", lambda: CORES)
    monkeypatch.chdir(tmp_path)
    flag = f"--{'.'.join(path)}"
    assert _run(command, f"{flag}=1000") == 2
    expected = f"{flag}=1000: expected at most 24, 8 for each of {CORES} processor cores"
    assert expected in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    check_cores(_replaced(_default(command), path, 24))


@pytest.mark.parametrize(
    ("command", "flags"),
    [
        ("egovcp-collect", ["--num_envs=65536", "--episodes=200000"]),
        ("egovcp-eval", ["--num_envs=65536", "--episodes=200000", "--controllers=hold"]),
        ("egovcp-train-ppo", ["--robots=65536"]),
        ("egovcp-train-lowlevel", ["--robots=65536"]),
    ],
)
def test_more_than_the_memory_holds_is_refused(
    command: str,
    flags: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("egovcp.hardware.available_bytes", lambda: 10**8)
    monkeypatch.chdir(tmp_path)
    assert _run(command, *flags) == 2
    told = capsys.readouterr().err
    assert flags[0] in told
    assert "0.1 GB are free" in told
    assert not list(tmp_path.iterdir())


def test_robots_that_no_episode_is_left_for_need_no_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("egovcp.hardware.available_bytes", lambda: 10**8)
    config = _default("egovcp-eval")
    names = {"num_envs": 65_536, "controllers": "hold", "output_dir": str(tmp_path / "x")}
    dataclasses.replace(config, **names, episodes=20).check()
