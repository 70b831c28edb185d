"""Checks that the files of a dataset are regular files inside its folder."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

from egovcp.errors import DataError

_FIELD = re.compile(r"\{(?:chunk_index|file_index)(?::0?[1-9]?d)?\}")


def check_template(template: object, path: Path, folder: str = "data") -> None:
    """Raise `DataError` unless ``template``, read from ``path``, names files inside ``folder``, of
    the dataset.

    Only plain fields are allowed, because Python's format language can read attributes.
    """
    name = "data_path" if folder == "data" else "video_path"
    if not isinstance(template, str):
        raise DataError.at(path, f"{name} {template!r} is not a file template")
    parts = PurePosixPath(template)
    if parts.is_absolute() or ".." in parts.parts:
        raise DataError.at(path, f"{name} {template!r} leads outside of the dataset")
    if any(part.startswith(".") for part in parts.parts):
        raise DataError.at(path, f"{name} {template!r} names hidden files")
    plain = _FIELD.sub("", template)
    if folder == "videos":
        plain = plain.replace("{video_key}", "")
    if not template.startswith(f"{folder}/") or re.search(r"[^\w./-]", plain, re.ASCII):
        raise DataError.at(
            path,
            f"{name} {template!r} is not a file template; expected one below {folder}/ "
            "with the fields chunk_index and file_index",
        )


def require_file(root: Path, path: Path) -> None:
    """Raise `DataError` unless ``path`` is a regular file inside ``root``.

    Links may also lead to the folder of blobs beside a snapshot in the Hub's cache, where
    huggingface_hub stores a download.
    """
    try:
        target = path.resolve(strict=True)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DataError.at(path, "missing; the dataset is incomplete") from error
    except RuntimeError as error:
        raise DataError.at(path, "a loop of symbolic links") from error
    except OSError as error:
        raise DataError.at(path, f"cannot be opened: {error.strerror}") from error
    if not any(target.is_relative_to(folder) for folder in _allowed_folders(root)):
        raise DataError.at(path, f"a link that leads outside of the dataset, to {target}")
    if not target.is_file():
        kind = "a folder" if target.is_dir() else "not a regular file"
        raise DataError.at(path, f"{kind}, expected a file")


def _allowed_folders(root: Path) -> list[Path]:
    folders = [root.resolve()]
    if root.parent.name == "snapshots":
        folders.append(root.resolve().parents[1] / "blobs")
    return folders


def files_below(folder: Path) -> list[Path]:
    """All files and links in ``folder``, at any depth, sorted; links are not followed.

    Hidden files and folders are ignored, as by `datasets`: macOS writes ``.DS_Store``, and
    ``._NAME`` beside each file on other file systems.
    """
    if folder.is_symlink():
        return [folder]
    found: list[Path] = []
    for parent, folders, files in folder.walk():
        folders[:] = [name for name in folders if not name.startswith(".")]
        linked = [name for name in folders if (parent / name).is_symlink()]
        found += [parent / name for name in [*files, *linked] if not name.startswith(".")]
    return sorted(found)
