import pytest

from egovcp.model import Batch, WorldModel
from egovcp.testing import random_batch, toy_model


@pytest.fixture(scope="module")
def model() -> WorldModel:
    """An untrained model; tests must not change it."""
    return toy_model()


@pytest.fixture
def batch() -> Batch:
    return random_batch(size=3, length=7)
