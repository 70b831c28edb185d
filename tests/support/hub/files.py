"""Lists and sends the files of a revision."""

from __future__ import annotations

import hashlib
import re
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import urlencode

from tests.support.hub.messages import Request, Response, json_response
from tests.support.hub.store import Commit, File, HttpError, Store

_PAGE = 1000  # entries
_RANGE = re.compile(r"bytes=(\d*)-(\d*)")


def tree(store: Store, request: Request) -> Response:
    """List a folder, page by page."""
    commit = store.commit(request.repo, request.parts["revision"])
    folder = request.parts.get("path", "")
    entries = _below(commit, folder)
    if folder and not entries:
        raise HttpError(404, f"{folder} does not exist", "EntryNotFound")
    if request.query.get("recursive", "false").lower() != "true":
        depth = len(PurePosixPath(folder).parts) + 1
        entries = {p: e for p, e in entries.items() if len(PurePosixPath(p).parts) == depth}
    first = int(request.query.get("cursor", 0))
    page = [entries[path] for path in sorted(entries)[first : first + _PAGE]]
    headers = {}
    if first + _PAGE < len(entries):
        query = urlencode({**request.query, "cursor": first + _PAGE})
        here = f"{request.endpoint}/api/{request.repo}/tree/{commit.sha}"
        headers["Link"] = f'<{here}{"/" + folder if folder else ""}?{query}>; rel="next"'
    return json_response(page, headers=headers)


def paths_info(store: Store, request: Request) -> Response:
    """Describe the files and folders asked for; what does not exist is left out."""
    commit = store.commit(request.repo, request.parts["revision"])
    entries = _below(commit, "")
    wanted = request.form().get("paths", [])
    return json_response(
        [entries[path.strip("/")] for path in wanted if path.strip("/") in entries]
    )


def resolve(store: Store, request: Request) -> Response:
    """Send a file, or the range of it that is asked for."""
    commit = store.commit(request.repo, request.parts["revision"])
    file = commit.files.get(request.parts["path"])
    if file is None:
        raise HttpError(404, "Entry not found", "EntryNotFound")
    start, stop = _range(request.headers.get("range", ""), file.size)
    headers = {
        "X-Repo-Commit": commit.sha,
        "ETag": f'"{file.sha256 if file.lfs else file.oid}"',
        "Accept-Ranges": "bytes",
        "Content-Type": "application/octet-stream",
    }
    if file.lfs:
        headers |= {"X-Linked-Etag": headers["ETag"], "X-Linked-Size": str(file.size)}
    if stop - start < file.size:
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{file.size}"
    status = 206 if "Content-Range" in headers else 200
    blob = store.blob(file.sha256)
    return Response(status, headers=headers, file=blob, start=start, length=stop - start)


def _range(header: str, size: int) -> tuple[int, int]:
    """First byte and the one after the last."""
    found = _RANGE.fullmatch(header.strip())
    if found is None or found.groups() == ("", ""):
        return 0, size
    first, last = found.groups()
    start = int(first) if first else max(0, size - int(last))
    stop = min(size, int(last) + 1) if first and last else size
    if start >= max(stop, 1):
        raise HttpError(416, f"range {header} of {size} bytes")
    return start, stop


def _below(commit: Commit, folder: str) -> dict[str, dict[str, Any]]:
    """Files and folders below ``folder``, by path."""
    entries: dict[str, dict[str, Any]] = {}
    prefix = f"{folder}/" if folder else ""
    inside: dict[str, list[str]] = {}  # folder -> its files
    for path, file in commit.files.items():
        if not path.startswith(prefix):
            continue
        entries[path] = _entry(path, file)
        for parent in map(str, PurePosixPath(path).parents):
            if parent not in (".", folder) and parent.startswith(prefix):
                inside.setdefault(parent, []).append(f"{path}:{file.oid}")
    return entries | {path: _folder(path, names) for path, names in inside.items()}


def _entry(path: str, file: File) -> dict[str, Any]:
    entry: dict[str, Any] = {"type": "file", "path": path, "oid": file.oid, "size": file.size}
    if file.lfs:
        entry["lfs"] = {"oid": file.sha256, "size": file.size, "pointerSize": 134}
    return entry


def _folder(path: str, names: list[str]) -> dict[str, Any]:
    digest = hashlib.sha1("\n".join(sorted(names)).encode(), usedforsecurity=False)
    return {"type": "directory", "path": path, "oid": digest.hexdigest(), "size": 0}
