"""The training curve as table and picture."""

import csv

import pytest
from torch.utils.tensorboard import SummaryWriter

from egovcp_train.lowlevel.curve import COLUMNS, read, write


@pytest.fixture
def run(tmp_path):
    with SummaryWriter(str(tmp_path / "tensorboard")) as records:
        for i in range(450):
            for tag in COLUMNS.values():
                records.add_scalar(tag, i / 450, 1000 * (i + 1))
    return tmp_path


def test_rows_are_means_of_stretches_of_the_run(run):
    rows = read(run)
    assert len(rows) == 225
    assert rows[0]["steps"] == 2000
    assert rows[-1]["steps"] == 450_000
    assert rows[0]["difficulty"] == pytest.approx(0.5 / 450)
    assert rows[0]["falls per robot and minute"] == pytest.approx(60 * 0.5 / 450)


def test_it_leaves_a_table_and_a_picture(run):
    write(read(run), run / "curve")
    with (run / "curve.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == 225
    assert set(table[0]) == {"steps", *COLUMNS}
    assert (run / "curve.png").stat().st_size > 5_000
