"""Reports of hundreds of cells."""

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module", autouse=True)
def few_resamples() -> Iterator[None]:
    """A bootstrap interval for each cell, whose last digits are not tested here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("egovcp.eval_scores._RESAMPLES", 500)
        yield
