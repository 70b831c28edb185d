"""Options of the memory benchmark."""

import memory
import pytest


def test_there_are_no_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["memory.py", "--rounds", "3"])
    monkeypatch.setattr(memory, "peak_mb", lambda task, episodes: 1.0)
    with pytest.raises(SystemExit):
        memory.main()
