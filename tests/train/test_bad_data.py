"""egovcp-train refuses data that it cannot learn from, before it trains or writes anything."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from egovcp import spec
from egovcp_train.train import main
from tests.support.arguments import Arguments

type Damage = Callable[[Path], object]

DATA = "data/chunk-000/file-000.parquet"


def _json(name: str, edit: Callable[[dict[str, Any]], object]) -> Damage:
    def damage(root: Path) -> None:
        content = json.loads((root / name).read_text())
        edit(content)
        (root / name).write_text(json.dumps(content))

    return damage


def _info(edit: Callable[[dict[str, Any]], object]) -> Damage:
    return _json("meta/info.json", edit)


def _table(edit: Callable[[pa.Table], pa.Table]) -> Damage:
    def damage(root: Path) -> None:
        pq.write_table(edit(pq.read_table(root / DATA)), root / DATA)

    return damage


def _column(name: str, edit: Callable[[list[Any]], list[Any]]) -> Damage:
    def change(table: pa.Table) -> pa.Table:
        at = table.schema.get_field_index(name)
        field = table.schema.field(at)
        return table.set_column(at, field, pa.array(edit(table[name].to_pylist()), field.type))

    return _table(change)


def _cut(root: Path) -> None:
    content = (root / DATA).read_bytes()
    (root / DATA).write_bytes(content[: len(content) // 2])


def _foreign(root: Path) -> None:
    """A LeRobot dataset of another robot, which egovcp has not collected."""
    shutil.rmtree(root)
    (root / "meta").mkdir(parents=True)
    features = {"observation.state": {"dtype": "float32", "shape": [6], "names": None}}
    info = {
        "codebase_version": "v3.0",
        "fps": 25,
        "total_episodes": 1,
        "total_frames": 10,
        "features": features,
        "data_path": DATA,
    }
    (root / "meta" / "info.json").write_text(json.dumps(info))


def _not_a_number(row: int) -> Callable[[list[Any]], list[Any]]:
    def edit(rows: list[Any]) -> list[Any]:
        if isinstance(rows[row], list):
            rows[row][3] = float("nan")
        else:
            rows[row] = float("nan")
        return rows

    return edit


@pytest.mark.parametrize("mode", ["ram", "stream"])
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        pytest.param(_cut, "damaged", id="damaged"),
        pytest.param(_foreign, "", id="foreign"),
        pytest.param(
            _info(lambda i: i["features"].pop(spec.DEPTH_KEY)), "missing", id="missing-feature"
        ),
        pytest.param(_table(lambda t: t.drop(["next.reward"])), "next.reward", id="missing-column"),
        pytest.param(
            _info(lambda i: i["features"]["observation.state"].update(shape=[73])),
            "expected [74]",
            id="wrong-shape",
        ),
        pytest.param(_column("next.reward", _not_a_number(30)), "not finite", id="nan-reward"),
        pytest.param(_column("observation.state", _not_a_number(30)), "not finite", id="nan-state"),
        pytest.param(_column("action", _not_a_number(30)), "", id="nan-action"),
    ],
)
def test_bad_data_is_refused_before_training(
    arguments: Arguments,
    dataset_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    damage: Damage,
    message: str,
    mode: str,
) -> None:
    bad = Path(shutil.copytree(dataset_root, tmp_path / "bad"))
    damage(bad)
    argv = arguments(tmp_path / "run", dataset__root=bad, loading__mode=mode)
    assert main(argv) == 3
    said = capsys.readouterr()
    assert said.out == ""
    line = said.err.splitlines()[-1]  # a progress bar may come before
    assert line.startswith("egovcp-train: error: ")
    assert str(bad) in line
    assert message in line
    assert not (tmp_path / "run").exists()
