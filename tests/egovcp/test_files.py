"""Files that somebody else wrote are refused unless they are regular, bounded and plain JSON."""

from __future__ import annotations

import hashlib
import json
import os
import socket
from pathlib import Path

import pytest

from egovcp import files
from egovcp.files import UnsafeFileError
from tests.support.limited import run_limited


def test_a_regular_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    content = {"a": [1, 2.5, "ü[{", None, True], "b": {"c": "\U0001f600"}}
    path.write_text(json.dumps(content), encoding="utf-8")
    assert files.read_json(path) == content
    assert files.read_bytes(path, 1000) == path.read_bytes()
    assert files.sha256(path) == hashlib.sha256(path.read_bytes()).hexdigest()
    (tmp_path / "link").symlink_to(path)
    assert files.read_json(tmp_path / "link") == content


@pytest.mark.parametrize(
    ("kind", "words"),
    [("fifo", "a FIFO"), ("device", "a device"), ("folder", "a folder"), ("socket", "a socket")],
)
@pytest.mark.parametrize("linked", [False, True])
def test_special_files_are_refused(
    kind: str, words: str, linked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # a socket's path is short
    path = Path("a.json")
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "device":
        path = Path("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    else:
        socket.socket(socket.AF_UNIX).bind(str(path))
    if linked:
        Path("link").symlink_to(path)
        path = Path("link")

    def refused() -> int:
        for read in (files.read_json, files.sha256, files.require_regular):
            with pytest.raises(UnsafeFileError, match=f"{words}, expected a regular file"):
                read(path)
        return 0

    result = run_limited(refused, seconds=5, memory_bytes=64 << 20)
    assert result.exit_code == 0, result.output


def test_a_file_over_the_limit_is_refused_without_reading_it(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # sparse
    with pytest.raises(UnsafeFileError, match=r"too large: 1099511627776 bytes, expected at most"):
        files.read_json(path)
    with pytest.raises(UnsafeFileError, match="too large: 1099511627776 bytes"):
        files.sha256(path, 10)


def test_a_file_that_hides_its_size_is_refused() -> None:
    with pytest.raises(UnsafeFileError, match="too large: more bytes, expected at most 10"):
        files.read_bytes(Path("/proc/self/status"), 10)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 33 + "]" * 33, "nested more than 32 levels"),
        ("[" * 100_000, "nested more than 32 levels"),
        ('{"a":' * 900 + "1" + "}" * 900, "nested more than 32 levels"),
        ('["]]]]", ' * 33 + "1" + "]" * 33, "nested more than 32 levels"),
        ("NaN", "holds NaN"),
        ("[-Infinity]", "holds -Infinity"),
        ("[1e999]", "1e999, which is infinite"),
        ('["\\ud800"]', "not valid Unicode"),
        ("1" * 5000, "not JSON"),
        ("{", "not JSON"),
        ("", "not JSON"),
    ],
)
def test_json_that_must_not_be_used_is_refused(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(UnsafeFileError, match=words):
        files.read_json(path)


def test_brackets_in_strings_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    content = ["[" * 100, '"[' * 100, "\\" + "{" * 100]
    path.write_text(json.dumps(content))
    assert files.read_json(path) == content
    path.write_text("[" * 32 + "]" * 32)
    files.read_json(path)


def test_other_encodings_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b'{"a": "\xff"}')
    with pytest.raises(UnsafeFileError, match="byte 7 is not UTF-8"):
        files.read_json(path)
