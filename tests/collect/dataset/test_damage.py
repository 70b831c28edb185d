"""`egovcp-dataset check` and loading for training find each kind of damage and name the file."""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from egovcp import spec
from egovcp.data import DatasetConfig, DatasetReader, EpisodeStore
from egovcp.data.metadata import verify_hashes
from egovcp.errors import DataError
from egovcp_collect.dataset.cli import main

from . import damage as d
from .damage import COLLECTION, DATA, EPISODES, HASHES, INFO, MORE_DATA, STATS, TASKS

pytestmark = [pytest.mark.usefixtures("no_network"), pytest.mark.timeout(5, func_only=True)]


@dataclass(frozen=True)
class Case:
    """A damage, and where it must be found."""

    name: str
    damage: d.Damage
    file: str
    episode: int | None = None
    frame: int | None = None
    training: bool = True
    """Loading for training must raise, too."""
    by_hash: bool = False
    """Found only by the recorded hashes."""


def _config(**options: object) -> Callable[[Any], object]:
    return lambda content: content.setdefault("config", {}).update(options)


_WIDE = pa.list_(pa.float64(), spec.STATE_DIM)
_SHORT = {"names": ["a"] * 6, "shape": [6]}
_NAN = float("nan")

CASES = [
    # files cut short, with flipped bits, empty, missing, or of another kind
    Case("data cut to nothing", d.cut(DATA, 0.0), DATA, 0),
    Case("data cut in its first page", d.cut(DATA, 0.001), DATA, 0),
    Case("data cut in the middle", d.cut(DATA, 0.5), DATA, 0),
    Case("data cut in its footer", d.cut(DATA, 0.99), DATA, 0),
    Case("second data file cut", d.cut(MORE_DATA, 0.7), MORE_DATA, 3),
    Case("episodes table cut", d.cut(EPISODES, 0.5), EPISODES),
    Case("tasks table cut", d.cut(TASKS, 0.5), TASKS),
    Case("info cut", d.cut(INFO, 0.5), INFO),
    Case("collection cut", d.cut(COLLECTION, 0.5), COLLECTION),
    Case("hashes cut", d.cut(HASHES, 0.5), HASHES, training=False, by_hash=True),
    Case("bit flipped in a pixel", d.flip_pixel, DATA, 1),
    Case("bit flipped at the end of the data", d.flip(DATA, -3), DATA, 0),
    Case("bit flipped in the footer", d.flip(DATA, -60), DATA, training=False, by_hash=True),
    Case("bit flipped in info", d.flip(INFO, 3), INFO),
    Case("bit flipped in tasks", d.flip(TASKS, 1), TASKS, training=False, by_hash=True),
    *(
        Case(f"{name} missing", d.remove(name), name)
        for name in (INFO, TASKS, COLLECTION, "meta/episodes", MORE_DATA)
    ),
    Case("stats missing", d.remove(STATS), STATS, training=False),
    Case("info empty", d.replace(INFO, ""), INFO),
    Case("info a list", d.replace(INFO, "[]"), INFO),
    Case("info a number", d.replace(INFO, "7" * 5000), INFO),
    Case("info nested deeply", d.replace(INFO, "[" * 100_000), INFO),
    Case("info not UTF-8", lambda r: (r / INFO).write_bytes(b"\xff{}"), INFO),
    Case("data a folder", d.folder(DATA), DATA),
    Case("info a folder", d.folder(INFO), INFO),
    Case("data a pipe", d.pipe(DATA), DATA),
    # paths
    Case("path upwards", d.info(data_path="data/../../{chunk_index}/{file_index}"), INFO),
    Case("absolute path", d.info(data_path="/etc/{chunk_index}"), INFO),
    Case("path that is code", d.info(data_path="data/{chunk_index.__class__}"), INFO),
    Case("path that is huge", d.info(data_path="data/{chunk_index:999999999d}"), INFO),
    Case("path no text", d.info(data_path=[1]), INFO),
    Case("data linked from elsewhere", d.outside(DATA), DATA),
    Case("info linked from elsewhere", d.outside(INFO), INFO),
    Case("chunk linked from elsewhere", d.outside("data/chunk-000"), DATA),
    Case(
        "foreign file",
        lambda r: (r / "data/extra.parquet").write_bytes(b"PAR1"),
        "data/extra.parquet",
        training=False,
    ),
    Case(
        "foreign meta file",
        lambda r: (r / "meta/more.json").write_text("{}"),
        "meta/more.json",
        training=False,
        by_hash=True,
    ),
    # what info.json says
    Case("older format", d.info(codebase_version="v2.1"), INFO),
    Case("other rate", d.info(fps=30), INFO),
    Case("false total of episodes", d.info(total_episodes=7), INFO),
    Case("false total of frames", d.info(total_frames=1), INFO),
    Case("false total of tasks", d.info(total_tasks=9), INFO, training=False),
    Case("total as text", d.info(total_episodes="6"), INFO),
    Case("split beyond the end", d.info(splits={"train": "0:7"}), INFO, training=False),
    Case("features a list", d.info(features=[1, 2]), INFO),
    Case("feature missing", d.edit(INFO, lambda i: i["features"].pop("action")), INFO),
    Case("other type", d.feature("action", dtype="float64"), INFO),
    Case("other shape", d.feature("action", **_SHORT), INFO),
    Case("other names", d.feature("observation.state", names=["x"] * 74), INFO),
    Case(
        "depth in metres",
        d.feature(spec.DEPTH_KEY, info={"is_depth_map": True, "depth_unit": "m"}),
        INFO,
    ),
    # the table of episodes
    Case("no episodes", d.no_episodes, EPISODES),
    Case("episode listed twice", d.column("episode_index", d.put(1, 0), EPISODES), EPISODES, 1),
    Case("wrong length", d.column("length", d.put(2, 11), EPISODES), EPISODES, 2),
    Case("wrong range", d.column("dataset_to_index", d.put(1, 20), EPISODES), EPISODES, 1),
    Case(
        "wrong file",
        d.column("data/file_index", d.put(0, 5), EPISODES),
        "data/chunk-000/file-005.parquet",
        0,
    ),
    Case(
        "other task in the table",
        d.column("tasks", lambda rows: rows.__setitem__(0, ["arch"]), EPISODES),
        EPISODES,
        0,
        training=False,
    ),
    Case("other tasks", d.column("task", d.put(0, "juggle"), TASKS), DATA, 0, 0),
    # what collection.json says
    Case("record missing", d.edit(COLLECTION, lambda c: c["episodes"].pop()), COLLECTION),
    Case("scene no object", d.edit(COLLECTION, _config(env=[1])), COLLECTION),
    Case("camera no object", d.edit(COLLECTION, _config(env={"camera": 1})), COLLECTION),
    Case("walk no pair", d.edit(COLLECTION, _config(step_ticks=5)), COLLECTION),
    Case("walk no boundary", d.edit(COLLECTION, _config(boundary=[1])), COLLECTION),
    Case("records no list", d.edit(COLLECTION, lambda c: c.update(episodes={})), COLLECTION),
    Case(
        "record no object",
        d.edit(COLLECTION, lambda c: c["episodes"].insert(0, 1) or c["episodes"].pop()),
        COLLECTION,
        0,
    ),
    Case("task no name", d.record(1, task=""), COLLECTION, 1),
    Case("other task in the record", d.record(1, task="juggle"), EPISODES, 1),
    Case("time limit as text", d.record(1, time_limit="12"), COLLECTION, 1),
    Case("time limit too short", d.record(1, time_limit=3), DATA, 1),
    Case("length in the record", d.record(1, length=8), COLLECTION, 1),
    Case("seed as text", d.record(1, metadata={"seed": "abc"}), COLLECTION, 1),
    Case("sums of rewards a list", d.record(1, metadata={"reward_terms": [1]}), COLLECTION, 1),
    Case("sum of a reward", d.record(1, metadata={"reward_terms": {"a": 3}}), COLLECTION, 1),
    Case("contacts as text", d.record(1, metadata={"contact_ticks": {"a": ""}}), COLLECTION, 1),
    Case("digest of another", d.record(1, sha256="0" * 64), DATA, 1),
    Case("digest no digest", d.record(1, sha256=7), COLLECTION, 1),
    Case("no controller", d.edit(COLLECTION, lambda c: c.pop("controller_id")), COLLECTION),
    Case("older specification", d.edit(COLLECTION, lambda c: c.update(spec_version=0)), COLLECTION),
    # frames; 12 in episode 0, 7 in episode 1
    Case("files swapped", d.swap(DATA, MORE_DATA), DATA, 0, 0),
    Case("rows missing", d.rows(lambda t: t.slice(0, 30)), DATA, 2),
    Case("rows doubled", d.rows(lambda t: pa.concat_tables([t, t])), DATA, training=False),
    Case("rows reversed", d.rows(lambda t: t.take([*range(31)][::-1])), DATA, 0, 0),
    Case("column missing", d.rows(lambda t: t.drop_columns(["next.reward"])), DATA, 0),
    Case(
        "column unknown", d.rows(lambda t: t.append_column("x", t["index"])), DATA, training=False
    ),
    Case("wider type", d.retype("observation.state", _WIDE), DATA, 0),
    Case(
        "lists of other lengths",
        d.retype("action", pa.list_(pa.float32())),
        DATA,
        training=False,
        by_hash=True,
    ),
    Case(
        "short list",
        lambda r: (
            d.retype("action", pa.list_(pa.float32()))(r),
            d.column("action", lambda rows: rows[15].pop())(r),
        ),
        DATA,
        1,
        3,
    ),
    Case("reward NaN", d.column("next.reward", d.put(14, _NAN)), DATA, 1, 2),
    Case("state infinite", d.column("observation.state", d.put(14, float("inf"))), DATA, 1, 2),
    Case("action NaN", d.column("action", d.put(14, _NAN)), DATA, 1, 2),
    Case("action outside", d.column("action", d.put(14, 1.5)), DATA, 1, 2),
    Case("value empty", d.column("next.reward", d.put(14, None)), DATA, 1, 2),
    Case("done in the middle", d.column("next.done", d.put(14, True)), DATA, 1, 2),
    Case("never done", d.column("next.done", d.put(18, False)), DATA, 1, 6),
    Case("truncated early", d.column("next.truncated", d.put(14, True)), DATA, 1, 2),
    Case("time repeated", d.column("timestamp", d.put(14, 0.04)), DATA, 1, 2),
    Case("time NaN", d.column("timestamp", d.put(14, _NAN)), DATA, 1, 2),
    Case(
        "rates mixed",
        d.column(
            "timestamp", lambda rows: rows.__setitem__(slice(12, 19), [t / 2 for t in rows[12:19]])
        ),
        DATA,
        1,
        1,
    ),
    Case("index repeated", d.column("index", d.put(14, 13)), DATA, 1, 2),
    Case("frame repeated", d.column("frame_index", d.put(14, 1)), DATA, 1, 2),
    Case("row of another episode", d.column("episode_index", d.put(14, 0)), DATA, 1, 2),
    Case("other task", d.column("task_index", d.put(14, 0)), DATA, 1, 2),
    Case("task out of range", d.column("task_index", d.put(14, 77)), DATA, 1, 2),
    Case("value altered", d.column("next.reward", d.put(14, 0.5)), DATA, 1),
    Case(
        "commands of another time",
        d.column(
            "observation.state", lambda rows: rows.__setitem__(slice(12, 14), rows[12:14][::-1])
        ),
        DATA,
        1,
    ),
    Case("image cut", d.column(spec.DEPTH_KEY, d.blob(14, lambda b: b[:3000])), DATA, 1, 2),
    Case("image empty", d.column(spec.DEPTH_KEY, d.blob(14, lambda b: b"")), DATA, 1, 2),
    Case("image null", d.column(spec.DEPTH_KEY, d.blob(14, lambda b: None)), DATA, 1, 2),
    Case(
        "image no TIFF",
        d.column(spec.DEPTH_KEY, d.blob(14, lambda b: b"\x89PNG" + b[4:])),
        DATA,
        1,
        2,
    ),
    Case(
        "image turned",
        d.column(
            spec.DEPTH_KEY, d.blob(14, lambda b: b[:18] + b[30:34] + b[22:30] + b[18:22] + b[34:])
        ),
        DATA,
        1,
        2,
    ),
    Case("depth beyond the range", d.column(spec.DEPTH_KEY, d.blob(14, d.deeper)), DATA, 1, 2),
    # statistics
    Case("mean wrong", d.statistic("observation.state", "mean", [0.5] * 74), STATS, training=False),
    Case("deviation NaN", d.statistic("action", "std", [_NAN] * 7), STATS, training=False),
    Case("statistic missing", d.statistic("action", "min", None), STATS, training=False),
    Case(
        "feature without statistics",
        d.edit(STATS, lambda s: s.pop(spec.DEPTH_KEY)),
        STATS,
        training=False,
    ),
]


@pytest.fixture
def case(request: pytest.FixtureRequest, copy: Path) -> Case:
    """A damaged copy; without the list of hashes, unless only that can tell."""
    case: Case = request.param
    if not case.by_hash:
        (copy / HASHES).unlink()
    case.damage(copy)
    return case


def _cases(cases: Iterable[Case]) -> pytest.MarkDecorator:
    chosen = [pytest.param(case, id=case.name) for case in cases]
    return pytest.mark.parametrize("case", chosen, indirect=True)


@_cases(CASES)
def test_the_check_names_file_episode_and_frame(
    case: Case, copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    assert main(["check", str(copy), f"--json={report}"]) == 3
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    assert case.file in printed.out
    found = json.loads(report.read_text())
    assert not found["ok"]
    places = [(p["file"], p["episode"], p["frame"]) for p in found["problems"]]
    assert (case.file, case.episode, case.frame) in places


@_cases(case for case in CASES if case.training)
def test_training_does_not_start(case: Case, copy: Path) -> None:
    with pytest.raises(DataError, match=case.file.rpartition("/")[2]):
        EpisodeStore.load([DatasetReader.open(DatasetConfig(root=str(copy)))])


@pytest.mark.parametrize("name", [DATA, MORE_DATA, EPISODES, INFO, STATS, TASKS, COLLECTION])
def test_any_changed_byte_is_found_by_its_hash(copy: Path, name: str) -> None:
    size = (copy / name).stat().st_size
    content = (copy / name).read_bytes()
    for at in range(0, size, max(1, size // 20)):
        d.flip(name, at)(copy)
        with pytest.raises(DataError, match=name):
            verify_hashes(copy)
        (copy / name).write_bytes(content)
    verify_hashes(copy)
