"""A small publication, and a retry policy short enough for tests."""

import pytest

from egovcp.hub import Content, Publication, RetryPolicy


@pytest.fixture
def quick() -> RetryPolicy:
    """Two tries, hardly a pause."""
    return RetryPolicy(attempts=2, wait_s=0.01, timeout_s=20)


@pytest.fixture
def publication() -> Publication:
    """Three files, one of them large in the Hub's eyes."""
    return Publication(
        repo_id="me/small",
        contents={
            "README.md": Content(b"---\nlicense: apache-2.0\n---\nA card.\n"),
            "meta/info.json": Content(b"{}\n"),
            "data/chunk-000/file-000.parquet": Content(bytes(range(256)) * 40),
        },
        message="three files",
        owned=("data", "meta"),
        moving_tag="v3.0",
    )
