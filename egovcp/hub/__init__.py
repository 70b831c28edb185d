"""The Hugging Face Hub over unreliable networks, for datasets and models.

`publish` commits files at once, `fetch` downloads a commit to a folder, `snapshot` to the cache,
and `HubFileCache` file by file. `call_hub` applies the same time limits, retries and errors to
other calls of `huggingface_hub`.
"""

from egovcp.hub.errors import HubUnreachable, LostUpdate, RepoType, hub_errors, hub_token
from egovcp.hub.fetch import fetch, is_local_path, is_repo_id, resolve, snapshot
from egovcp.hub.file_cache import HubFileCache
from egovcp.hub.publish import (
    Content,
    Publication,
    PublishConfig,
    Published,
    ensure_repository,
    publish,
)
from egovcp.hub.retry import RetryPolicy, call_hub

__all__ = [
    "Content",
    "HubFileCache",
    "HubUnreachable",
    "LostUpdate",
    "Publication",
    "PublishConfig",
    "Published",
    "RepoType",
    "RetryPolicy",
    "call_hub",
    "ensure_repository",
    "fetch",
    "hub_errors",
    "hub_token",
    "is_local_path",
    "is_repo_id",
    "publish",
    "resolve",
    "snapshot",
]
