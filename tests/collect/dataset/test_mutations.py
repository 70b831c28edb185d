"""Whatever is damaged in a dataset, `egovcp-dataset check` finds it or it changes nothing.

Each mutation is given to the command in a forked process: exit code 3 with one line that
names a file at fault, or exit code 0 if what is loaded is as before; no traceback, no network, no
code of the dataset executed, less than 5 s and 2 GB.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest
from PIL import Image, TiffImagePlugin

from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, schema
from egovcp_collect.dataset.cli import main
from tests.support.limited import run_limited

from .conftest import COLLECTED, walk
from .damage import HASHES
from .mutations import MARKER, MUTATIONS, mutate

#: One of each kind, then more of them.
SEEDS = (
    *range(len(MUTATIONS)),
    *(pytest.param(n, marks=pytest.mark.slow) for n in range(len(MUTATIONS), 200)),
)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of six frames, in two shards."""
    root = tmp_path_factory.mktemp("tiny") / "tiny"
    with DatasetWriter(root, COLLECTED, shard_episodes=2) as writer:
        for number in range(3):
            writer.add(walk(number, 6, task="wall" if number % 2 else "ball"))
    # everything is imported before the first fork
    assert main(["check", str(root)]) == 0
    assert TiffImagePlugin.TiffImageFile.format in Image.OPEN
    return root


#: Nothing uses the statistics of the others, and LeRobot's tools leave wrong ones.
_CHECKED = [key for key in schema.FEATURES if key not in ("index", "episode_index", "task_index")]


def _content(root: Path) -> str:
    """Digest of everything that is loaded from a dataset and used."""
    reader = DatasetReader.open(DatasetConfig(root=str(root)))
    parts: list[object] = [asdict(reader.origin), reader.fps, reader.lengths.tolist()]
    parts += [reader.task_names, {key: reader.stats[key] for key in _CHECKED}]
    for index, episode in enumerate(reader):
        facts = [episode.task, episode.time_limit, dict(episode.metadata)]
        parts += [episode.digest(), facts, reader.identity(index)]
    for key in _CHECKED:
        if key != "observation.images.ego_depth":
            mean, std = reader.episode_stats(key)
            parts += [mean.tolist(), std.tolist()]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _succeeds(condition: Callable[[], bool]) -> bool:
    return run_limited(lambda: 0 if condition() else 1).exit_code == 0


@pytest.fixture(scope="module")
def content(tiny: Path) -> str:
    return _content(tiny)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_mutation_is_found_or_changes_nothing(
    seed: int, tiny: Path, content: str, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(tiny, tmp_path / "d"))
    mutation = mutate(root, seed)
    result = run_limited(lambda: main(["check", str(root)]))
    about = f"{mutation}: {result}"
    assert not result.timed_out, about
    assert not result.has_traceback, about
    assert result.exit_code in (0, 3), about
    assert not (tmp_path / MARKER).exists()
    if mutation.files == (HASHES,):
        assert result.exit_code == 3, about
    if result.exit_code == 3:
        error = result.output.strip().splitlines()[-1]
        assert error.startswith("egovcp-dataset check: error: "), about
        assert any(name in result.output for name in mutation.files if name), about
    else:
        assert _succeeds(lambda: _content(root) == content), about
