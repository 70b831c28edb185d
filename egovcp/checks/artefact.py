"""Does a policy artefact load, conform and plan?"""

from __future__ import annotations

import numpy as np

from egovcp.artefact import Artefact, load_artefact
from egovcp.checks.world_model import RandomInputs, check_world_model
from egovcp.errors import ArtefactError, ConformanceError


def check_artefact(path: str, revision: str = "") -> Artefact:
    """Load an artefact, check its model, and let it plan once.

    Raises:
        ArtefactError: it does not load, does not conform, or does not plan.
        EnvironmentFailure: the Hub cannot be reached.
    """
    artefact = load_artefact(path, revision)
    inputs = RandomInputs(1, seed=0)
    try:
        check_world_model(artefact.world_model)
    except ConformanceError as error:
        raise ArtefactError(f"{artefact.path}: {error}; train again") from error
    steps = [
        artefact.make_policy(seed=0).act(
            inputs.depth.numpy().astype(np.uint16), inputs.state.numpy()
        )
        for _ in range(2)
    ]
    plan = steps[0].plan
    if not (np.isfinite(plan).all() and np.abs(plan).max() <= 1 and np.isfinite(steps[0].value)):
        raise ArtefactError(f"{artefact.path}: its plan is not finite or leaves [-1, 1]")
    if not np.array_equal(plan, steps[1].plan):
        raise ArtefactError(f"{artefact.path}: a seed does not repeat a plan")
    return artefact
