"""The generated reference pages."""

import importlib.metadata
import io
import runpy
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "generate_reference.py"


def test_a_command_whose_help_fails_ends_the_build(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(argv: Sequence[str]) -> int:
        print("a package is missing", file=sys.stderr)
        return 5

    def load() -> Callable[[Sequence[str]], int]:
        return failing

    script = SimpleNamespace(name="egovcp-broken", load=load)
    pages = SimpleNamespace(open=lambda *_: io.StringIO())
    monkeypatch.setitem(sys.modules, "mkdocs_gen_files", pages)
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: [script])
    with pytest.raises(SystemExit, match="egovcp-broken --help=all failed: a package is missing"):
        runpy.run_path(str(SCRIPT))
