"""Failures of the Hub and its library as errors that name cause and remedy."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import ssl
from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Literal

from egovcp.errors import ArtifactError, DataError, EgovcpError, EnvironmentFailure, UsageError
from egovcp.terminal import without_token

if TYPE_CHECKING:
    from huggingface_hub.errors import HfHubHTTPError

type RepoType = Literal["dataset", "model"]
"""Type of a Hub repository; each has its own namespace of ids."""

_MISSING: Final[dict[RepoType, type[EgovcpError]]] = {"dataset": DataError, "model": ArtifactError}


_CERTIFICATES: Final = ("SSL_CERT_FILE", "SSL_CERT_DIR")  # the first that is set is used


class LostUpdate(EnvironmentFailure):
    """The branch was changed by another client between the check and the commit."""


class HubUnreachable(EnvironmentFailure):
    """A request to the Hub failed and may succeed later."""

    def __init__(self, message: str, pause_s: float = 0.0) -> None:
        super().__init__(message)
        self.pause_s = pause_s
        """Pause that the Hub demands before the next request, s."""


def unreachable(failure: str, pause_s: float = 0.0) -> HubUnreachable:
    """The error of a request that failed like this."""
    return HubUnreachable(
        f"the Hub cannot be used: {failure}; check the network and HF_ENDPOINT, or try again later",
        pause_s,
    )


@cache
def http_library() -> Any:
    """The HTTP library of the installed `huggingface_hub`: the module `httpx` or `httpx2`."""
    from huggingface_hub.errors import HfHubHTTPError

    bases = (base.__module__.partition(".")[0] for base in HfHubHTTPError.__mro__)
    return importlib.import_module(next(name for name in bases if name.startswith("httpx")))


@contextlib.contextmanager
def hub_errors(
    repo_id: str, revision: str = "", writing: bool = False, repo_type: RepoType = "dataset"
) -> Iterator[None]:
    """Turn every failure of `huggingface_hub` within the block into an `EgovcpError`.

    An `EgovcpError` of the block, and an error of a file, pass through.

    Raises:
        DataError: there is no such dataset or revision.
        ArtifactError: there is no such model or revision.
        UsageError: the id is not valid.
        EnvironmentFailure: no network, no access, no space, or no valid answer.
    """
    try:
        yield
    except (
        OSError,
        ValueError,
        KeyError,
        RuntimeError,
        EgovcpError,
        http_library().HTTPError,
    ) as error:
        translated = _translate(error, repo_id, revision or "main", writing, repo_type)
        if translated is error:
            raise
        raise translated from error


def hub_token() -> str | None:
    """The user's token; raises `UsageError` if it has characters that are not valid."""
    import huggingface_hub

    found = huggingface_hub.get_token()
    if found is not None and not (found.isascii() and found.isprintable() and " " not in found):
        raise UsageError(
            "the Hub token has characters that are not valid; set HF_TOKEN again, or run "
            "`hf auth login`"
        )
    return found


def _translate(
    error: Exception, repo_id: str, revision: str, writing: bool, repo_type: RepoType
) -> Exception:
    from huggingface_hub.errors import (
        GatedRepoError,
        HfHubHTTPError,
        HFValidationError,
        LocalEntryNotFoundError,
        OfflineModeIsEnabled,
        RevisionNotFoundError,
    )

    name = f"{repo_id}@{revision}"
    chain = list(_chain(error))
    for link in chain:
        match link:
            case EgovcpError():
                return link
            case RevisionNotFoundError():
                return _MISSING[repo_type](
                    f"the Hub has {repo_type} {repo_id}, but not {name}; check the revision"
                )
            case GatedRepoError():
                return EnvironmentFailure(
                    f"{repo_type} {repo_id} is gated: request access on its page, then run "
                    "`hf auth login`"
                )
            case HfHubHTTPError() if link.response.status_code == 404:
                return _MISSING[repo_type](
                    f"the Hub has no {repo_type} {repo_id} (404 at {link.response.url.path}), or "
                    "it is private and needs `hf auth login`; check the id"
                )
            case HfHubHTTPError():
                return _refusal(link, name, writing, repo_type)
            case OfflineModeIsEnabled():
                return EnvironmentFailure(
                    f"HF_HUB_OFFLINE is set, so {repo_type} {name} cannot be requested from the "
                    "Hub; unset it"
                )
            case _ if isinstance(link, http_library().TransportError):
                return unreachable(f"{describe(link)} for {repo_type} {name}")
            case HFValidationError():
                return UsageError(f"{repo_id!r} is not the id of a {repo_type}: {_line(link)}")
    network = isinstance(error, (ConnectionError, TimeoutError, LocalEntryNotFoundError))
    if isinstance(error, (FileNotFoundError, ssl.SSLError)) and error.filename is None:
        given = [f"{n}={os.environ[n]}" for n in _CERTIFICATES if os.environ.get(n)]
        return EnvironmentFailure(
            f"the certificates of {given[0] if given else 'certifi'} cannot be loaded: "
            f"{error.strerror or error}; change or unset the variable, or install certifi again"
        )
    if isinstance(error, OSError) and error.errno is not None and not network:
        return error  # the disk
    if isinstance(chain[-1], (ConnectionError, TimeoutError, RuntimeError)):  # of hf_xet
        return unreachable(f"{_line(chain[-1])} for {repo_type} {name}")
    return EnvironmentFailure(
        f"the Hub gave no usable answer about {repo_type} {name}: {_line(chain[-1])}; check the "
        "network and HF_ENDPOINT, or try again later"
    )


def _refusal(error: HfHubHTTPError, name: str, writing: bool, repo_type: RepoType) -> EgovcpError:
    status, path = error.response.status_code, error.response.url.path
    repo_id, user = name.split("@")[0], name.split("/")[0]
    need = f"write access to {repo_type}s of {user}" if writing else f"read access to {repo_id}"
    if status == 401:
        return EnvironmentFailure(
            f"not logged in to the Hub (401 at {path}): run `hf auth login`, or set HF_TOKEN, "
            f"with a token that has {need}"
        )
    if status == 403:
        return EnvironmentFailure(
            f"the token has no permission (403 at {path}): it needs {need}; create one at "
            "https://huggingface.co/settings/tokens and run `hf auth login`"
        )
    if status == 412:
        return LostUpdate(
            f"another client has published to {name} in the meantime; nothing was published; check "
            "that version, then push again"
        )
    message = without_token(error.server_message or "").splitlines()
    reason = f": {message[0]}" if message else ""
    may_pass = status >= 500 or status in (408, 429)
    remedy = "try again later" if may_pass else f"check {name}"
    return EnvironmentFailure(
        f"the Hub answers {status} {error.response.reason_phrase} at {path}{reason}; {remedy}"
    )


def _chain(error: BaseException) -> Iterator[BaseException]:
    link: BaseException | None = error
    while link is not None:
        yield link
        link = link.__cause__ or (None if link.__suppress_context__ else link.__context__)


def describe(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__} ({lines[0]})" if lines else type(error).__name__


def _line(error: BaseException) -> str:
    if isinstance(error, json.JSONDecodeError):
        return "it is not JSON"
    lines = without_token(str(error)).strip().splitlines()
    return lines[0] if lines else type(error).__name__
