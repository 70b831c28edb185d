"""The Hugging Face Hub over a network that fails: bounded requests, whole versions, clear errors.

`publish` puts files there in one commit, `fetch` brings a commit to a folder, `snapshot` to the
cache, `Shelf` file by file as they are needed; `retrying` and `explained` hold every other call of
Hugging Face's library to the same limits and errors. Datasets and models alike.
"""

from egovcp.hub.failures import LostUpdate, RepoType, explained, token
from egovcp.hub.fetch import fetch, resolve, snapshot
from egovcp.hub.options import PublishConfig
from egovcp.hub.publish import Content, Publication, Published, publish, reserve
from egovcp.hub.repo_id import is_local_path, is_repo_id
from egovcp.hub.retry import HubUnreachable, RetryPolicy, retrying
from egovcp.hub.shelf import Shelf

__all__ = [
    "Content",
    "HubUnreachable",
    "LostUpdate",
    "Publication",
    "PublishConfig",
    "Published",
    "RepoType",
    "RetryPolicy",
    "Shelf",
    "explained",
    "fetch",
    "is_local_path",
    "is_repo_id",
    "publish",
    "reserve",
    "resolve",
    "retrying",
    "snapshot",
    "token",
]
