"""A fake Hugging Face Hub for tests and trials without a network.

A local server behind ``HF_ENDPOINT``, with enough of the Hub's interface to create a
repository, upload, commit, tag, list, download and stream a dataset. It keeps contents on
disk, counts requests and fails on demand (`FakeHub.fail`). On the command line::

    python -m tests.support.hub --root DIR --port 8080
"""

from tests.support.hub.environment import client_factory, hub_environment, redirect_hub
from tests.support.hub.faults import Fault
from tests.support.hub.server import FakeHub

__all__ = ["FakeHub", "Fault", "client_factory", "hub_environment", "redirect_hub"]
