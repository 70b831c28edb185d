"""How files come in: large ones first, by their hash, then one commit that names them all."""

from __future__ import annotations

import base64
import json
from pathlib import PurePosixPath
from typing import Any

from tests.support.hub.messages import Request, Response, json_response
from tests.support.hub.store import Commit, File, HttpError, Store, pointer_oid

_LARGE = 10 * 2**20  # bytes
_LARGE_SUFFIXES = {".parquet", ".png", ".jpg", ".mp4", ".safetensors", ".bin", ".onnx", ".rrd"}


def validate(store: Store, request: Request) -> Response:
    """Accept any card."""
    request.content()
    return json_response({"errors": [], "warnings": []})


def preupload(store: Store, request: Request) -> Response:
    """Say of each file whether it is a large one, and what the branch has in its place."""
    head = store.commit(request.repo, request.parts["revision"])
    files = request.json()["files"]
    return json_response({"files": [_mode(head, file) for file in files]})


def _mode(head: Commit, file: dict[str, Any]) -> dict[str, Any]:
    path = file["path"]
    binary = b"\0" in base64.b64decode(file.get("sample", ""))
    large = PurePosixPath(path).suffix in _LARGE_SUFFIXES or file["size"] > _LARGE or binary
    mode = {"path": path, "uploadMode": "lfs" if large else "regular", "shouldIgnore": False}
    if (there := head.files.get(path)) is not None:
        mode["oid"] = there.sha256 if there.lfs else there.oid
    return mode


def lfs_batch(store: Store, request: Request) -> Response:
    """Say where to put each large file that is not here yet."""
    store.refs(request.repo)
    return json_response(
        {
            "transfer": "basic",
            "objects": [
                _object(store, request.endpoint, o["oid"], o["size"])
                for o in request.json()["objects"]
            ],
        }
    )


def _object(store: Store, endpoint: str, oid: str, size: int) -> dict[str, Any]:
    found: dict[str, Any] = {"oid": oid, "size": size}
    if not store.blob(oid).exists():
        href = f"{endpoint}/lfs/{oid}"
        found["actions"] = {"upload": {"href": href}, "verify": {"href": f"{href}/verify"}}
    return found


def lfs_upload(store: Store, request: Request) -> Response:
    """Take a large file."""
    store.add_blob(request.body, request.parts["oid"])
    return Response(headers={"ETag": f'"{request.parts["oid"]}"'})


def lfs_verify(store: Store, request: Request) -> Response:
    """Confirm that a large file has arrived."""
    blob = store.blob(request.parts["oid"])
    if not blob.exists() or blob.stat().st_size != request.json()["size"]:
        raise HttpError(404, "no such object")
    return json_response({})


def commit(store: Store, request: Request) -> Response:
    """Change many files at once: all of it, or nothing."""
    lines = [json.loads(line) for line in request.content().splitlines() if line]
    header = next(line["value"] for line in lines if line["key"] == "header")
    head = store.commit(request.repo, request.parts["revision"])
    changes: dict[str, File | None] = {}
    for line in lines:
        changes |= _change(store, head, line["key"], line["value"])
    made = store.advance(
        request.repo,
        request.parts["revision"],
        header.get("parentCommit", ""),
        header["summary"],
        changes,
    )
    url = f"{request.endpoint}/{request.repo}/commit/{made.sha}"
    return json_response(
        {"success": True, "commitOid": made.sha, "commitUrl": url, "hookOutput": ""}
    )


def _change(store: Store, head: Commit, key: str, value: dict[str, Any]) -> dict[str, File | None]:
    if key == "header":
        return {}
    path = str(value["path"])
    if key == "deletedFile":
        return {path: None}
    if key == "deletedFolder":
        return {p: None for p in head.files if p.startswith(path.rstrip("/") + "/")}
    if key == "file":
        return {path: store.add_small(base64.b64decode(value["content"]))}
    if key == "lfsFile":
        blob, oid = store.blob(value["oid"]), str(value["oid"])
        if not blob.exists():
            raise HttpError(400, f"the content of {path} was never uploaded")
        size = blob.stat().st_size
        return {path: File(oid, size, pointer_oid(oid, size), lfs=True)}
    raise HttpError(400, f"unknown operation {key}")
