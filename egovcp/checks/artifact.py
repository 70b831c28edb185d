"""Does a policy artifact load, conform and plan?"""

from __future__ import annotations

import numpy as np

from egovcp.artifact import Artifact, load_artifact
from egovcp.checks.world_model import RandomInputs, check_world_model
from egovcp.errors import ArtifactError, ConformanceError


def check_artifact(path: str, revision: str = "") -> Artifact:
    """Load an artifact, check its model, and let it plan once.

    Raises:
        ArtifactError: it does not load, does not conform, or does not plan.
        EnvironmentFailure: the Hub cannot be reached.
    """
    artifact = load_artifact(path, revision)
    inputs = RandomInputs(1, seed=0)
    try:
        check_world_model(artifact.world_model)
    except ConformanceError as error:
        raise ArtifactError(f"{artifact.path}: {error}; train again") from error
    steps = [
        artifact.make_policy(seed=0).act(
            inputs.depth.numpy().astype(np.uint16), inputs.state.numpy()
        )
        for _ in range(2)
    ]
    plan = steps[0].plan
    if not (np.isfinite(plan).all() and np.abs(plan).max() <= 1 and np.isfinite(steps[0].value)):
        raise ArtifactError(f"{artifact.path}: its plan is not finite or leaves [-1, 1]")
    if not np.array_equal(plan, steps[1].plan):
        raise ArtifactError(f"{artifact.path}: a seed does not repeat a plan")
    return artifact
