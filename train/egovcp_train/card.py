"""The README.md that tells others what a policy is: all of it from its own manifest."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Mapping
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from egovcp.artifact import Artifact, load_artifact
from egovcp.atomic import write_text
from egovcp_train.curves import draw_curves

CARD: Final = "README.md"
ASSETS: Final = "assets"
CURVES: Final = f"{ASSETS}/training.png"
_PACKAGES: Final = ("egovcp", "egovcp-train", "torch", "lerobot", "numpy")
_ABOUT: Final = {
    "ball": "block a thrown ball with hand or wrist before it meets the body",
    "wall": "brace with the hands on a wall that one is pushed towards",
    "arch": "walk up to an arch that is too low for an upright robot, and duck under it",
}
#: How a figure's name begins -> what it is; the longest that fits.
_METRICS: Final = {
    "value/r2": "share of the variance of the Monte Carlo return that Q explains",
    "value/slope": "regression of the return on Q; 1 is calibrated",
    "depth/moving_h": "RMS error on moving pixels, m, that many ticks ahead without observation",
    "depth/repeat_h": "the same for repeating the last image",
    "latent/active": "dimensions of z that carry information",
    "latent/kl": "KL divergence of posterior and prior, nats per step",
    "termination/": "how well falls are foreseen",
    "state/": "error of the proprioception, standardised",
}


def versions() -> dict[str, str]:
    """Of Python and of the packages that a training run rests on."""
    return {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}}


def write_card(folder: Path, run: Path, repo_id: str) -> None:
    """Put card and training curves beside the artifact in ``folder``.

    Args:
        folder: the artifact.
        run: output folder of the run, whose records the curves are drawn from.
        repo_id: id on the Hub that the examples name; empty: they name the folder.
    """
    draw_curves(run, folder / CURVES)
    write_text(folder / CARD, card_text(load_artifact(str(folder)), repo_id))


def card_text(artifact: Artifact, repo_id: str) -> str:
    """The card of a policy; it shows the curves that lie beside it.

    Args:
        artifact: the policy.
        repo_id: id on the Hub, `user/name`, that the examples name; empty: they name the folder.
    """
    from huggingface_hub import ModelCard

    manifest = artifact.manifest
    name = repo_id or str(artifact.path)
    title = repo_id.partition("/")[2] or "egovcp policy"
    card = ModelCard.from_template(
        _front_matter(manifest, title),
        template_str=(files(__package__) / "model_card.md").read_text(encoding="utf-8"),
        title=title,
        name=name,
        on_hub=bool(repo_id),
        tasks=[(task, _ABOUT.get(task, "")) for task in manifest.get("tasks", [])],
        datasets=[_dataset(d, manifest) for d in manifest.get("datasets", [])],
        controller_id=artifact.controller_id,
        step=manifest.get("step", "an unknown number of"),
        command=_command(manifest),
        versions=", ".join(f"{k} {v}" for k, v in _versions(manifest).items()),
        metrics=[(k, f"{v:.4g}", _meaning(k)) for k, v in sorted(_figures(manifest).items())],
        curves=CURVES if (artifact.path / CURVES).is_file() else "",
        parameters=f"{sum(p.numel() for p in artifact.world_model.parameters()):,}",
        sizes=artifact.world_model.config,
        planner=artifact.planner,
        features=manifest["features"],
    )
    return f"{str(card).rstrip()}\n"


def _front_matter(manifest: Mapping[str, Any], title: str) -> Any:
    from huggingface_hub import EvalResult, ModelCardData

    datasets = [d for d in manifest.get("datasets", []) if d.get("repo_id")]
    first = datasets[0] if datasets else None
    results = [
        EvalResult(
            task_type="robotics",
            dataset_type=first["repo_id"],
            dataset_name=first["repo_id"],
            dataset_split="held-out episodes",
            dataset_revision=first.get("revision") or None,
            metric_type=name,
            metric_value=value,
        )
        for name, value in sorted(_figures(manifest).items())
        if first
    ]
    return ModelCardData(
        license="apache-2.0",
        library_name="egovcp",
        pipeline_tag="robotics",
        tags=["egovcp", "LeRobot", "unitree_g1", "humanoid", "depth", "world-model"],
        datasets=[d["repo_id"] for d in datasets] or None,
        model_name=title if results else None,
        eval_results=results or None,
    )


def _figures(manifest: Mapping[str, Any]) -> dict[str, float]:
    """The held-out metrics that are numbers; null stands for one that was not finite."""
    return {k: float(v) for k, v in manifest.get("heldout", {}).items() if v is not None}


def _meaning(metric: str) -> str:
    known = [prefix for prefix in _METRICS if metric.startswith(prefix)]
    return _METRICS[max(known, key=len)] if known else ""


def _dataset(entry: Mapping[str, Any], manifest: Mapping[str, Any]) -> dict[str, str]:
    root = manifest.get("train_config", {}).get("dataset", {}).get("root", "")
    return {
        "repo_id": entry.get("repo_id") or "",
        "revision": entry.get("revision") or "",
        "episodes": entry.get("episodes") or "",
        "root": Path(root).name,
    }


def _command(manifest: Mapping[str, Any]) -> str:
    words = manifest.get("command")
    return shlex.join(words) if words else "not recorded"


def _versions(manifest: Mapping[str, Any]) -> dict[str, str]:
    known: dict[str, str] = manifest.get("versions") or {"egovcp": manifest["egovcp_version"]}
    return known
