"""Where `egovcp-mcap to-dataset` may write a dataset."""

from __future__ import annotations

from pathlib import Path

import pytest

from egovcp.data import destination, open_dataset
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
    record: Record,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    root, table = tmp_path / "mnt", tmp_path / "mountinfo"
    root.mkdir()
    table.write_text(f"1 2 254:0 / {root} rw - ext4 /dev/x rw\n")
    monkeypatch.setattr(destination, "_MOUNTS", table)
    assert main(["to-dataset", str(record()), f"--dataset.root={root}"]) == 5
    assert f"{root} is a mount point" in capsys.readouterr().err
    assert not list(root.iterdir())
