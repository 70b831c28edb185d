"""Repositories and the names of their revisions."""

from __future__ import annotations

from typing import Any

from tests.support.hub.messages import Request, Response, json_response
from tests.support.hub.store import HttpError, Store

_DATE = "2026-01-01T00:00:00.000Z"


def whoami(store: Store, request: Request) -> Response:
    """Everybody is the same user."""
    return json_response(
        {"type": "user", "id": "0", "name": "user", "fullname": "User", "orgs": []}
    )


def create(store: Store, request: Request) -> Response:
    """Make a repository; 409 if it exists, with the same address in the response."""
    wish = request.json()
    repo = f"{wish.get('organization') or 'user'}/{wish['name']}"
    kind = f"{wish.get('type') or 'model'}s"
    private = bool(wish.get("private")) or wish.get("visibility") == "private"
    prefix = "" if kind == "models" else f"{kind}/"
    made = {"url": f"{request.endpoint}/{prefix}{repo}", "id": repo, "name": repo}
    try:
        store.create(f"{kind}/{repo}", private)
    except HttpError as error:
        return json_response({"error": error.message, **made}, error.status)
    return json_response(made)


def info(store: Store, request: Request) -> Response:
    """Describe a repository at a revision."""
    commit = store.commit(request.repo, request.parts.get("revision", "main"))
    return json_response(
        {
            "_id": commit.sha[:24],
            "id": request.parts["repo"],
            "author": request.parts["repo"].split("/")[0],
            "sha": commit.sha,
            "private": store.refs(request.repo).private,
            "gated": False,
            "disabled": False,
            "lastModified": _DATE,
            "createdAt": _DATE,
            "downloads": 0,
            "likes": 0,
            "tags": [],
            "siblings": [{"rfilename": path} for path in sorted(commit.files)],
        }
    )


def refs(store: Store, request: Request) -> Response:
    """List branches and tags."""
    found = store.refs(request.repo)

    def entries(names: Any, folder: str) -> list[dict[str, str]]:
        return [
            {"name": name, "ref": f"refs/{folder}/{name}", "targetCommit": sha}
            for name, sha in names.items()
        ]

    return json_response(
        {
            "branches": entries(found.branches, "heads"),
            "tags": entries(found.tags, "tags"),
            "converts": [],
            "pullRequests": [],
        }
    )


def commits(store: Store, request: Request) -> Response:
    """List commits, the newest first."""
    history = store.history(request.repo, request.parts["revision"])
    return json_response(
        [
            {"id": c.sha, "title": c.title, "message": "", "authors": [], "date": _DATE}
            for c in history
        ]
    )


def tag(store: Store, request: Request) -> Response:
    """Name a commit; 409 if the tag exists."""
    store.tag(request.repo, request.json()["tag"], request.parts["revision"])
    return json_response({})


def untag(store: Store, request: Request) -> Response:
    """Remove a tag."""
    store.tag(request.repo, request.parts["name"], None)
    return json_response({})


def branch(store: Store, request: Request) -> Response:
    """Start a branch; 409 if it exists."""
    start = request.json().get("startingPoint") or "main"
    store.branch(request.repo, request.parts["name"], start)
    return json_response({})


def unbranch(store: Store, request: Request) -> Response:
    """Remove a branch."""
    store.branch(request.repo, request.parts["name"], None)
    return json_response({})
