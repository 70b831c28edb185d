"""Which arithmetic a policy plans with, by its name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from egovcp.artifact import load_artifact
from egovcp.plan.config import BackendName
from egovcp_deploy.policy import backend_of


@pytest.mark.parametrize("backend", ["eager", "float32", "bfloat16"])
def test_a_backend_that_was_asked_for_is_the_one_that_is_named(
    artifact_dir: Path, backend: BackendName
) -> None:
    artifact = load_artifact(str(artifact_dir))
    artifact = replace(artifact, planner=replace(artifact.planner, backend=backend))
    assert backend_of(artifact.make_policy(1, 0)) == backend


@pytest.mark.parametrize(
    ("evaluator", "name"),
    [("Int8Evaluator", "int8"), ("FloatEvaluator", "float32"), ("ReferenceEvaluator", "eager")],
)
def test_auto_is_named_by_what_it_took(
    artifact_dir: Path, monkeypatch: pytest.MonkeyPatch, evaluator: str, name: str
) -> None:
    policy = load_artifact(str(artifact_dir)).make_policy(1, 0)
    assert policy.config.backend == "auto"
    monkeypatch.setattr(policy, "prepare", type(evaluator, (), {}))
    assert backend_of(policy) == name


def test_auto_takes_something_that_has_a_name(artifact_dir: Path) -> None:
    assert backend_of(load_artifact(str(artifact_dir)).make_policy(1, 0)) in ("int8", "float32")
