"""What the artifact says of the episodes that it was not trained on."""

import json

import pytest

from egovcp.data import DatasetReader, EpisodeIndex, describe_heldout
from egovcp.data import index as index_module


def test_the_held_out_episodes_are_named(
    reader: DatasetReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    index = EpisodeIndex.of([reader, reader], "heldout", 0.4)
    found = describe_heldout([reader, reader], 0.4)
    assert found["numbers"] == [index.number[index.dataset == d].tolist() for d in (0, 1)]
    assert found["count"] == len(index) == sum(map(len, found["numbers"]))
    assert found["fingerprint"] == index.fingerprint
    assert json.loads(json.dumps(found)) == found

    monkeypatch.setattr(index_module, "LISTED", found["count"] - 1)
    assert describe_heldout([reader, reader], 0.4) == found | {"numbers": None}
