"""A dataset of a task that is not installed is read, described and trained on."""

from __future__ import annotations

from pathlib import Path

import pytest

from egovcp.data import DatasetConfig, DatasetReader, DatasetWriter, EpisodeStore
from egovcp_collect.dataset.card import card_text
from egovcp_collect.dataset.cli import main

from .conftest import COLLECTED, walk


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("juggle") / "data"
    with DatasetWriter(folder, COLLECTED) as writer:
        for number in range(4):
            writer.add(walk(number, 12, task="juggle"))
    return folder


def test_it_is_checked_read_and_described(root: Path) -> None:
    assert main(["check", str(root)]) == 0
    reader = DatasetReader.open(DatasetConfig(root=str(root)))
    assert reader.read(0).task == "juggle"
    assert EpisodeStore.load([reader]).tasks == ("juggle",) * 4
    assert "| juggle |" in card_text(reader, "me/juggle")
