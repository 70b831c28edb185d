"""Routes: method and path pattern -> function that returns the response."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from tests.support.hub import files, repositories, uploads
from tests.support.hub.messages import Request, Response
from tests.support.hub.store import Store

_REPO = r"(?P<repo>[^/]+/[^/]+)"
_API = rf"/api/(?P<kind>models|datasets|spaces)/{_REPO}"
_GIT = rf"/((?P<kind>datasets|spaces)/)?{_REPO}"
_REVISION = r"(?P<revision>[^/]+)"
_OID = r"(?P<oid>[0-9a-f]{64})"


@dataclass(frozen=True)
class Route:
    """Requests of one kind; faults are ordered by its name."""

    name: str
    method: str
    pattern: re.Pattern[str]
    handler: Callable[[Store, Request], Response]


def _route(
    name: str, method: str, pattern: str, handler: Callable[[Store, Request], Response]
) -> Route:
    return Route(name, method, re.compile(pattern), handler)


#: Tried from top to bottom.
ROUTES = (
    _route("whoami", "GET", "/api/whoami-v2", repositories.whoami),
    _route("create", "POST", "/api/repos/create", repositories.create),
    _route("validate", "POST", "/api/validate-yaml", uploads.validate),
    _route("refs", "GET", f"{_API}/refs", repositories.refs),
    _route("commits", "GET", f"{_API}/commits/{_REVISION}", repositories.commits),
    _route("info", "GET", f"{_API}(/revision/{_REVISION})?", repositories.info),
    _route("tag", "POST", f"{_API}/tag/{_REVISION}", repositories.tag),
    _route("untag", "DELETE", f"{_API}/tag/(?P<name>[^/]+)", repositories.untag),
    _route("branch", "POST", f"{_API}/branch/(?P<name>[^/]+)", repositories.branch),
    _route("unbranch", "DELETE", f"{_API}/branch/(?P<name>[^/]+)", repositories.unbranch),
    _route("tree", "GET", f"{_API}/tree/{_REVISION}(/(?P<path>.+))?", files.tree),
    _route("paths", "POST", f"{_API}/paths-info/{_REVISION}", files.paths_info),
    _route("preupload", "POST", f"{_API}/preupload/{_REVISION}", uploads.preupload),
    _route("commit", "POST", f"{_API}/commit/{_REVISION}", uploads.commit),
    _route("lfs_batch", "POST", rf"{_GIT}\.git/info/lfs/objects/batch", uploads.lfs_batch),
    _route("lfs_upload", "PUT", f"/lfs/{_OID}", uploads.lfs_upload),
    _route("lfs_verify", "POST", f"/lfs/{_OID}/verify", uploads.lfs_verify),
    _route("metadata", "HEAD", f"{_GIT}/resolve/{_REVISION}/(?P<path>.+)", files.resolve),
    _route("resolve", "GET", f"{_GIT}/resolve/{_REVISION}/(?P<path>.+)", files.resolve),
)
