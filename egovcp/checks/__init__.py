"""Public conformance checks: does a part keep its contract with the others?

    check_world_model(model)     recurrence, reset, batching and shapes of a world model
    check_artefact(path)         a policy artefact loads, conforms and plans
    check_env(env, scenarios)    clock, reset, repeatability and limits of an environment
    check_dataset(config)        every episode reads, and its commands line up in time

Each returns quietly, or raises an `EgovcpError` that says what is wrong and where.
"""

from egovcp.checks.artefact import check_artefact
from egovcp.checks.dataset import check_dataset
from egovcp.checks.environment import check_env
from egovcp.checks.world_model import check_world_model
from egovcp.errors import ConformanceError

__all__ = [
    "ConformanceError",
    "check_artefact",
    "check_dataset",
    "check_env",
    "check_world_model",
]
