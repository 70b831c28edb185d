"""An argument is a folder or an id of the Hub."""

from pathlib import Path

import pytest

from egovcp.hub import is_local_path, is_repo_id


@pytest.mark.parametrize("text", ["user/name", "u/n", "my-org/ball.v2", "a_b/c-d", "7/x"])
def test_a_user_and_a_name_are_a_repo_id(text: str) -> None:
    assert is_repo_id(text)


@pytest.mark.parametrize(
    "text",
    [
        *("", "name", "/name", "user/", "a/b/c", "./ball", "../ball", "~/ball", "a/b--c"),
        *("a/b..c", "a/b.git", "a/b-", "a/.b", "a b/c", "a/b\n", "a/\0", "ü/b", f"a/{'b' * 95}"),
    ],
)
def test_anything_else_is_a_local_path(text: str) -> None:
    assert not is_repo_id(text)
    assert is_local_path(text)


def test_an_absent_folder_of_an_existing_parent_is_a_local_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert not is_local_path("runs/bal")
    (tmp_path / "runs").mkdir()
    assert is_local_path("runs/bal")


def test_a_file_or_a_broken_link_is_a_local_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "user").symlink_to("nowhere")
    assert not is_local_path("user/name")
    (tmp_path / "user").unlink()
    (tmp_path / "user").mkdir()
    (tmp_path / "user" / "name").symlink_to("name")
    assert is_local_path("user/name")
