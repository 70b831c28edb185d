"""What the Hub and its library complain of, as errors that say what to do."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final, Literal

from egovcp.errors import (
    ArtifactError,
    DataError,
    EgovcpError,
    EnvironmentFailure,
    UsageError,
)
from egovcp.hub.retry import http_library

if TYPE_CHECKING:
    from huggingface_hub.errors import HfHubHTTPError

type RepoType = Literal["dataset", "model"]
"""What a repository of the Hub holds; the two have their ids apart from each other."""

_MISSING: Final[dict[RepoType, type[EgovcpError]]] = {"dataset": DataError, "model": ArtifactError}


class LostUpdate(EnvironmentFailure):
    """Somebody else has published since one looked."""


@contextlib.contextmanager
def explained(
    repo_id: str, revision: str = "", writing: bool = False, repo_type: RepoType = "dataset"
) -> Iterator[None]:
    """Turn every failure of the Hub's library within the block into an `EgovcpError`.

    Put nothing but calls of that library inside.

    Raises:
        DataError: there is no such dataset or revision.
        ArtifactError: there is no such model or revision.
        UsageError: the id is not one.
        EnvironmentFailure: no network, no access, no space, or no sensible answer.
    """
    try:
        yield
    except (OSError, ValueError, KeyError, RuntimeError, EgovcpError, _http_error()) as error:
        explanation = _explain(error, repo_id, revision or "main", writing, repo_type)
        if explanation is error:
            raise
        raise explanation from error


def _http_error() -> type[Exception]:
    """The root of the errors of the library's HTTP library; evaluated once something was raised."""
    error: type[Exception] = http_library().HTTPError
    return error


def token() -> str | None:
    """The user's token, checked for characters that would end up in an error message.

    Raises:
        UsageError: it is not a token.
    """
    import huggingface_hub

    found = huggingface_hub.get_token()
    if found is not None and not (found.isascii() and found.isprintable() and " " not in found):
        raise UsageError(
            "the token for the Hub has characters that none has; set HF_TOKEN anew, or run "
            "`hf auth login`"
        )
    return found


def _explain(
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
        if isinstance(link, EgovcpError):
            return link
        if isinstance(link, RevisionNotFoundError):
            return _MISSING[repo_type](
                f"the Hub has {repo_type} {repo_id}, but not {name}; check the revision"
            )
        if isinstance(link, GatedRepoError):
            return EnvironmentFailure(
                f"{repo_type} {repo_id} is gated: ask for access on its page, then run "
                "`hf auth login`"
            )
        if isinstance(link, HfHubHTTPError) and link.response.status_code == 404:
            return _MISSING[repo_type](
                f"the Hub has no {repo_type} {repo_id} (404 at {link.response.url.path}), or it is "
                "private and yours to see only after `hf auth login`; check the id"
            )
        if isinstance(link, HfHubHTTPError):
            return _refused(link, repo_id, writing, repo_type)
        if isinstance(link, OfflineModeIsEnabled):
            return EnvironmentFailure(
                f"HF_HUB_OFFLINE is set, so the Hub cannot be asked for {repo_type} {name}; "
                "unset it"
            )
        if isinstance(link, HFValidationError):
            return UsageError(f"{repo_id!r} is no id of a {repo_type} on the Hub: {_line(link)}")
    if _is_local(error) and not isinstance(error, LocalEntryNotFoundError):
        return error  # the disk, not the network
    return EnvironmentFailure(
        f"the Hub gave no usable answer about {repo_type} {name}: {_line(chain[-1])}; check the "
        "network and HF_ENDPOINT, or try again later"
    )


def _refused(
    error: HfHubHTTPError, repo_id: str, writing: bool, repo_type: RepoType
) -> EgovcpError:
    status, path = error.response.status_code, error.response.url.path
    user = repo_id.split("/")[0]
    need = f"write access to {repo_type}s of {user}" if writing else f"read access to {repo_id}"
    if status == 401:
        return EnvironmentFailure(
            f"the Hub does not know you (401 at {path}): run `hf auth login`, or set HF_TOKEN, "
            f"with a token that has {need}"
        )
    if status == 403:
        return EnvironmentFailure(
            f"your token may not do that (403 at {path}): it needs {need}; make one at "
            "https://huggingface.co/settings/tokens and run `hf auth login`"
        )
    if status == 412:
        return LostUpdate(f"somebody else has published to {repo_id} meanwhile")
    said = _redacted(error.server_message or "").splitlines()
    reason = f": {said[0]}" if said else ""
    return EnvironmentFailure(
        f"the Hub answers {status} {error.response.reason_phrase} at {path}{reason}; try again "
        "later"
    )


def _is_local(error: BaseException) -> bool:
    network = isinstance(error, (ConnectionError, TimeoutError))
    return isinstance(error, OSError) and error.errno is not None and not network


def _chain(error: BaseException) -> Iterator[BaseException]:
    """The error and what led to it."""
    link: BaseException | None = error
    while link is not None:
        yield link
        link = link.__cause__ or (None if link.__suppress_context__ else link.__context__)


def _line(error: BaseException) -> str:
    if isinstance(error, json.JSONDecodeError):
        return "it is not JSON"
    lines = _redacted(str(error)).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _redacted(text: str) -> str:
    """The text without the user's token, should a server have echoed it."""
    import huggingface_hub

    found = huggingface_hub.get_token()
    return text.replace(found, "<token>") if found else text
