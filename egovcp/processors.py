"""The files that describe to LeRobot what to do before and after an egovcp policy.

LeRobot refuses a policy folder without them. Their steps change no number: depth and state
go in as they are, because the world model carries its statistics with its weights.
"""

from __future__ import annotations

from typing import Any, Final

from egovcp import spec

INPUT_FEATURES: Final[dict[str, Any]] = {
    spec.DEPTH_KEY: {"type": "VISUAL", "shape": [1, spec.DEPTH_ROWS, spec.DEPTH_COLS]},
    spec.STATE_KEY: {"type": "STATE", "shape": [spec.STATE_DIM]},
}
OUTPUT_FEATURES: Final[dict[str, Any]] = {
    spec.ACTION_KEY: {"type": "ACTION", "shape": [spec.ACTION_DIM]}
}

_IDENTITY = dict.fromkeys(("VISUAL", "STATE", "ACTION"), "IDENTITY")


def _step(name: str, **config: Any) -> dict[str, Any]:
    return {"registry_name": name, "config": config}


def _normalisation(name: str, features: dict[str, Any]) -> dict[str, Any]:
    return _step(name, eps=1e-8, features=features, norm_map=_IDENTITY)


def _pipeline(name: str, *steps: dict[str, Any]) -> dict[str, Any]:
    return {"name": name, "steps": list(steps)}


_TO_CPU = _step("device_processor", device="cpu", float_dtype=None)

#: File name -> content.
PROCESSORS: Final[dict[str, dict[str, Any]]] = {
    "policy_preprocessor.json": _pipeline(
        "policy_preprocessor",
        _step("rename_observations_processor", rename_map={}),
        _step("to_batch_processor"),
        _TO_CPU,
        _normalisation("normalizer_processor", {**INPUT_FEATURES, **OUTPUT_FEATURES}),
    ),
    "policy_postprocessor.json": _pipeline(
        "policy_postprocessor",
        _normalisation("unnormalizer_processor", OUTPUT_FEATURES),
        _TO_CPU,
    ),
}
