"""Where `egovcp-mcap to-dataset` may write a dataset."""

from __future__ import annotations

from pathlib import Path

import pytest

from egovcp.data import open_dataset
from egovcp_deploy.mcap.cli import main

from .conftest import Record


@pytest.mark.parametrize("is_there", [True, False])
def test_a_link_stays_and_its_target_is_written(
    is_there: bool, record: Record, tmp_path: Path
) -> None:
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
