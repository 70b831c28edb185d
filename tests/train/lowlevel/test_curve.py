"""The training curve as table and picture."""

import csv
from pathlib import Path

import pytest
from torch.utils.tensorboard import SummaryWriter

from egovcp_train.lowlevel.curve import COLUMNS, main, read


def _record(run: Path, first: int, last: int, value: float | None = None) -> Path:
    """Iterations ``first`` to ``last`` of 1000 steps each; by default all rises from 0 to 1."""
    with SummaryWriter(str(run / "tensorboard")) as records:
        for i in range(first, last):
            for tag in COLUMNS.values():
                records.add_scalar(tag, i / 450 if value is None else value, 1000 * (i + 1))
    return run


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return _record(tmp_path / "run", 0, 450)


def test_rows_are_means_of_stretches_of_the_run(run: Path):
    rows = read([run])
    assert len(rows) == 225
    assert rows[0]["steps"] == 2000
    assert rows[-1]["steps"] == 450_000
    assert rows[0]["difficulty"] == pytest.approx(0.5 / 450)
    assert rows[0]["falls per robot and minute"] == pytest.approx(60 * 0.5 / 450)


def test_a_continuation_takes_over_where_it_begins(run: Path, tmp_path: Path):
    """It went on from a checkpoint at 300 000 steps: what came after that is not its history."""
    later = _record(tmp_path / "later", 300, 500, value=7.0)
    rows = read([run, later])
    assert [row["steps"] for row in rows] == [2000.0 * (i + 1) for i in range(250)]
    assert rows[149]["difficulty"] == pytest.approx(298.5 / 450)
    assert all(row["difficulty"] == 7.0 for row in rows[150:])


def test_it_leaves_a_table_and_a_picture(run: Path):
    assert main([str(run), "--out", str(run / "curve")]) == 0
    with (run / "curve.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == 225
    assert set(table[0]) == {"steps", *COLUMNS}
    assert (run / "curve.png").stat().st_size > 5_000


def test_a_folder_without_records_is_refused(run: Path, tmp_path: Path, capsys):
    assert main([str(run), str(tmp_path / "none"), "--out", str(tmp_path / "curve")]) == 4
    assert str(tmp_path / "none") in capsys.readouterr().err
    assert not (tmp_path / "curve.csv").exists()
