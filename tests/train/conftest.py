"""A tiny dataset and the shortest of training runs."""

from pathlib import Path
from typing import Any

import draccus
import numpy as np
import pytest
import yaml

from egovcp import spec
from egovcp.data import DatasetWriter, Episode, Provenance
from egovcp.flags import flags_of, merged, options_of
from egovcp_train.config import PRESETS, TrainConfig
from tests.support.arguments import Arguments

CONTROLLER = "stance-test"


def _episode(number: int, length: int, limit: int) -> Episode:
    """A near block whose place gives the reward and the object's height.

    It ends by a fall if ``length`` is less than ``limit``.
    """
    rng = np.random.default_rng(number)
    depth = np.full((length, spec.DEPTH_ROWS, spec.DEPTH_COLS), 3000, dtype=np.uint16)
    column = rng.integers(0, 48)
    depth[:, 10:26, column : column + 16] = 800
    last = np.arange(length) == length - 1
    action = np.clip(rng.normal(0, 0.2, (length, spec.ACTION_DIM)).cumsum(0), -1, 1)
    return Episode(
        depth=depth,
        state=rng.normal(size=(length, spec.STATE_DIM)).astype(np.float32),
        action=action.astype(np.float32),
        reward=np.full(length, column / 48, dtype=np.float32),
        done=last,
        success=np.zeros(length, dtype=np.bool_),
        truncated=last & (length == limit),
        task="ball",
        time_limit=limit,
        object=np.tile(np.array([2, 0, column / 48, 1], np.float32), (length, 1)),
        metadata={"seed": 0, "episode": number},
    )


@pytest.fixture(scope="session")
def dataset_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight episodes, one of which ends in a fall; tests must not change it."""
    root = tmp_path_factory.mktemp("train") / "dataset"
    with DatasetWriter(root, Provenance(CONTROLLER, seed=0, command="collect")) as writer:
        for number in range(8):
            writer.add(_episode(number, 15 if number == 3 else 24, 24))
    return root


@pytest.fixture(scope="session")
def arguments(dataset_root: Path) -> Arguments:
    """Flags of a run that takes a second; keyword ``a__b`` stands for ``--a.b``.

    Options that are not flags go to a configuration file beside the output folder.
    """
    not_flags = options_of(TrainConfig).keys() - flags_of(TrainConfig).keys()

    def build(output: Path, *flags: str, **options: object) -> list[str]:
        values: dict[str, object] = {
            "output_dir": output,
            "dataset__root": dataset_root,
            "preset": "debug",
            "steps": 6,
            "save_freq": 3,
            "eval_freq": 0,
            "log_freq": 2,
            "batch_size": 2,
            "sampling__length": 6,
            "returns__steps": 5,
            "planner__samples": 16,
            "planner__elites": 4,
            "tensorboard": "false",
            "threads": 1,
            "device": "cpu",
            "mixed_precision": "no",
            **options,
        }
        named = {f"--{k.replace('__', '.')}": v for k, v in values.items() if v is not None}
        constants = {flag: named.pop(flag) for flag in not_flags & named.keys()}
        if constants:
            preset = PRESETS[str(named.pop("--preset"))]()
            named["--config_path"] = _config_file(output, preset, constants)
        return [*(f"{flag}={value}" for flag, value in named.items()), *flags]

    return build


def _config_file(output: Path, preset: TrainConfig, constants: dict[str, object]) -> Path:
    """A file with all options of a preset and some other constants."""
    options: dict[str, Any] = draccus.encode(preset)
    for flag, value in constants.items():
        nested: Any = value
        for part in reversed(flag.removeprefix("--").split(".")):
            nested = {part: nested}
        options = merged(options, nested)
    path = output.with_name(f"{output.name}.yaml")
    path.write_text(yaml.safe_dump(options), encoding="utf-8")
    return path
