"""Mutations of the JSON files: options, encoding, nesting, size."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final

from egovcp.artifact import CONFIG, WEIGHTS
from egovcp.manifest import PROCESSORS
from tests.support.file_mutations import Random, json_mutations, pick
from tests.support.policy_mutations.editing import (
    JSON_FILES,
    MARKER,
    Json,
    Mutate,
    edit_json,
    write_json,
)


def _options(content: Json) -> list[tuple[Json, str]]:
    """(object, key) of every option of the networks and of the planner, at any depth."""
    found: list[tuple[Json, str]] = []
    waiting = [content["world_model"], content["planner"]]
    while waiting:
        group = waiting.pop()
        for key, value in group.items():
            if isinstance(value, dict):
                waiting.append(value)
            found.append((group, key))
    return found


def _give_an_option_another_type(folder: Path, rng: Random) -> str:
    def change(content: Json) -> None:
        group, key = pick(rng, _options(content))
        wrong: list[Any] = ["wide", [], {"a": 1}, [[[]]], "1e30", [None], {}]
        wrong += [None] if not isinstance(group[key], dict) else [3]
        wrong += [True, "256"] if not isinstance(group[key], bool) else [1, "true"]
        wrong = [v for v in wrong if not (v == {} and isinstance(group[key], dict))]
        wrong = [v for v in wrong if not (v == [] and isinstance(group[key], list))]
        group[key] = pick(rng, wrong)

    return edit_json(folder, CONFIG, change)


def _give_a_size_an_absurd_number(folder: Path, rng: Random) -> str:
    def change(content: Json) -> None:
        name = pick(rng, ["hidden", "latent", "units", "channels", "loss"])
        number = pick(rng, [10**6, 20_000, 10**9, 10**30, 10**400, -1, 1e30, 1.5, None])
        network = content["world_model"]
        match name:
            case "loss":
                long = rng.random() < 0.5
                ahead = list(range(1, 100_000)) if long else [number, 8, 12]
                network["loss"]["multistep_horizons"] = ahead
            case "channels":
                network[name] = [number, 8, 8]
            case _:
                network[name] = number

    return edit_json(folder, CONFIG, change)


def _give_a_size_another_number(folder: Path, rng: Random) -> str:
    """Within its bounds, but not that of the weights."""

    def change(content: Json) -> None:
        changes: dict[str, Any] = {
            "hidden": 8192,
            "units": 8192,
            "latent": 9,
            "channels": [1024, 1024, 1024],
        }
        for name in rng.permutation(list(changes))[: int(rng.integers(1, 4))]:
            content["world_model"][str(name)] = changes[name]

    edit_json(folder, CONFIG, change)
    return f"{WEIGHTS}|{CONFIG}"


def _ask_for_a_huge_plan(folder: Path, rng: Random) -> str:
    def change(content: Json) -> None:
        name = pick(rng, ["samples", "horizon", "iterations"])
        content["planner"][name] = pick(rng, [10**6, 10**7, 10**9, 10**18, 10**300, 10**400, 1e9])

    return edit_json(folder, CONFIG, change)


def _drop_or_add_an_option(folder: Path, rng: Random) -> str:
    def change(content: Json) -> None:
        match int(rng.integers(4)):
            case 0:
                del content[pick(rng, ["world_model", "planner", "type"])]
            case 1:
                content[pick(rng, ["world_model", "planner"])]["surprise"] = 1
            case 2:
                content["type"] = pick(rng, ["act", "", 7, None, "EGOVCP"])
            case 3:
                content["world_model"]["loss"]["__class__"] = "os.system"

    return edit_json(folder, CONFIG, change)


def _make_json_huge(folder: Path, rng: Random) -> str:
    name = pick(rng, JSON_FILES)
    os.truncate(folder / name, 200 << 20)
    return str(name)


def _name_a_class_to_import(folder: Path, rng: Random) -> str:
    name = pick(rng, list(PROCESSORS))

    def change(content: Json) -> None:
        step = {"class": "malicious.Step", "config": {}}
        content["steps"] = pick(
            rng, [[step], [{**content["steps"][0], **step}], "steps", [3], None]
        )

    (folder / "malicious.py").write_text(f"open({str(folder / MARKER)!r}, 'w')\n")
    return edit_json(folder, name, change)


TEXT_MUTATIONS: Final[tuple[Mutate, ...]] = (
    _give_an_option_another_type,
    _give_a_size_an_absurd_number,
    _give_a_size_another_number,
    _ask_for_a_huge_plan,
    _drop_or_add_an_option,
    _make_json_huge,
    _name_a_class_to_import,
    *json_mutations(JSON_FILES, lambda folder, name, text, rng: write_json(folder, name, text)),
)
