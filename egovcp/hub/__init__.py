"""The Hugging Face Hub over a network that fails: bounded requests, whole versions, clear errors.

`publish` puts files there in one commit, `fetch` brings a commit to a folder; `patient` and
`explained` hold every other call of Hugging Face's library to the same limits and errors.
"""

from egovcp.hub.failures import LostUpdate, explained, token
from egovcp.hub.fetch import fetch, resolve
from egovcp.hub.patience import HubUnreachable, Patience, patient
from egovcp.hub.publish import Content, Publication, Published, publish

__all__ = [
    "Content",
    "HubUnreachable",
    "LostUpdate",
    "Patience",
    "Publication",
    "Published",
    "explained",
    "fetch",
    "patient",
    "publish",
    "resolve",
    "token",
]
