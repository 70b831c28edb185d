"""What each choice of world model and planner is worth: cells that differ in one of them.

    python benchmarks/ablations.py --set training --root data/ball --output outputs/ablations \\
        --steps 800 -- --threads=1 --eval_freq=0
    python benchmarks/ablations.py --set planner --policy RUN/checkpoints/last/pretrained_model \\
        --task ball --episodes 100 --output outputs/planner

Training cells are runs of egovcp-train with equal steps and seeds, measured on held-out episodes
as its manifests say; planner cells are egovcp-eval on the same scenarios. What follows `--` goes to
the command of every cell. A cell that is complete is never run again, so that the same command
continues where it was stopped; ablations.json and ablations.md hold what is there so far.
"""

from __future__ import annotations

import argparse
import importlib
import json
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ablation_cells import SETS
from ablation_table import markdown
from report import hardware

from egovcp.errors import EgovcpError, EnvironmentFailure, UsageError, suggest

type Run = Callable[[str, Sequence[str]], int]

MODULES = {"training": "egovcp_train.train", "planner": "egovcp_deploy.evaluate"}


def in_a_process(module: str, argv: Sequence[str]) -> int:
    """Run the command ``module``.main in a process of its own; its exit code."""
    code = f"import sys; from {module} import main; sys.exit(main())"
    return subprocess.run([sys.executable, "-c", code, *argv], check=False).returncode


def in_this_process(module: str, argv: Sequence[str]) -> int:
    """The same, here."""
    return int(importlib.import_module(module).main(list(argv)))


class Ablations:
    """The cells of one set, and the folder where their results are kept."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.kind: str = options.set
        self.options = options
        self.output: Path = options.output
        self.cells = _chosen(self.kind, options.cells)
        self.settings = self._settings()

    def _settings(self) -> dict[str, Any]:
        """What all cells have in common; results of other settings are not beside these."""
        o = self.options
        extra = [flag for flag in o.extra if flag != "--"]
        if self.kind == "training":
            roots = [str(Path(root).resolve()) for root in o.root]
            if not roots:
                raise UsageError("--root is missing: the dataset to train on")
            return {"datasets": roots, "steps": o.steps, "extra": extra}
        if not o.policy:
            raise UsageError("--policy is missing: the artefact to evaluate")
        policy = str(Path(o.policy).resolve()) if Path(o.policy).exists() else o.policy
        return {"policy": policy, "task": o.task, "episodes": o.episodes, "extra": extra}

    def execute(self, run: Run) -> list[dict[str, Any]]:
        """Run what is missing; all results, in the order of the cells."""
        results = []
        for name, flags in self.cells.items():
            for seed in self.options.seeds:
                results.append(self._cell(name, flags, seed, run))
                self._publish(results)
        return results

    def _cell(self, name: str, flags: Sequence[str], seed: int, run: Run) -> dict[str, Any]:
        path = self.output / f"{name}-{seed}.json"
        if path.exists():
            return self._kept(path)
        work = self.output / "runs" / f"{name}-{seed}"
        argv = [*self._argv(work, seed), *flags]
        print(f"--- {name}, seed {seed}: {' '.join(flags) or 'nothing changed'}", flush=True)
        start = time.perf_counter()
        code = run(MODULES[self.kind], argv)
        if code != 0:
            raise EnvironmentFailure(
                f"cell {name}, seed {seed}: {MODULES[self.kind]} ended with {code}; the same "
                "command continues here once the cause, named above, is mended"
            )
        result = {
            "cell": name,
            "seed": seed,
            "flags": list(flags),
            "settings": self.settings,
            "minutes": (time.perf_counter() - start) / 60,
            "tasks": self._measured(work),
        }
        _write(path, json.dumps(result, indent=2) + "\n")
        return result

    def _kept(self, path: Path) -> dict[str, Any]:
        result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if result["settings"] != self.settings:
            raise UsageError(
                f"{path} was made with {result['settings']}, not {self.settings}; name another "
                "--output"
            )
        return result

    def _argv(self, work: Path, seed: int) -> list[str]:
        s = self.settings
        if self.kind == "planner":
            flags = {"policy.path": s["policy"], "task": s["task"], "episodes": s["episodes"]}
            flags |= {"controllers": "planner", "output_dir": _fresh(work), "seed": seed}
        else:
            begun = (work / "checkpoints" / "last").exists()
            roots = s["datasets"]
            data = {"dataset.root": roots[0]}
            if len(roots) > 1:
                data = {"datasets": json.dumps([{"root": root} for root in roots])}
            flags = {**data, "steps": s["steps"], "seed": seed, "eval_freq": 0}
            flags["output_dir"] = work if begun else _fresh(work)
            flags |= {"resume": "true"} if begun else {}
        return [*(f"--{name}={value}" for name, value in flags.items()), *s["extra"]]

    def _measured(self, work: Path) -> dict[str, Any]:
        """Task -> its figures."""
        if self.kind == "planner":
            figures = json.loads((work / "eval.json").read_text(encoding="utf-8"))
            return {task: row["planner"] for task, row in figures.items()}
        manifest = work / "checkpoints" / "last" / "pretrained_model" / "manifest.json"
        found: dict[str, Any] = json.loads(manifest.read_text(encoding="utf-8"))["heldout_tasks"]
        return found

    def _publish(self, results: Sequence[dict[str, Any]]) -> None:
        command = shlex.join(["python", "benchmarks/ablations.py", *self.options.argv])
        content = {"results": list(results), "command": command, **hardware()}
        _write(self.output / "ablations.json", json.dumps(content, indent=2) + "\n")
        _write(self.output / "ablations.md", markdown(self.kind, results, command))


def _chosen(kind: str, names: str) -> dict[str, tuple[str, ...]]:
    known = SETS[kind]
    wanted = [name for name in names.split(",") if name] or list(known)
    for name in wanted:
        if name not in known:
            raise UsageError(f"unknown cell {name!r}{suggest(name, known)}")
    return {name: known[name] for name in wanted}


def _fresh(work: Path) -> Path:
    """``work`` without what an attempt left there that never came to a checkpoint."""
    shutil.rmtree(work, ignore_errors=True)
    work.parent.mkdir(parents=True, exist_ok=True)
    return work


def _write(path: Path, text: str) -> None:
    """Complete or not there at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """The options."""
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--set", choices=sorted(SETS), default="training")
    p.add_argument("--output", type=Path, required=True, help="folder of the results")
    p.add_argument("--cells", default="", help="names, separated by commas; none: all of the set")
    p.add_argument("--seeds", type=int, nargs="+", default=[0])
    p.add_argument("--root", action="append", default=[], help="dataset; several are mixed")
    p.add_argument("--steps", type=int, default=800, help="gradient steps of a training cell")
    p.add_argument("--policy", default="", help="artefact of the planner cells")
    p.add_argument("--task", default="ball", help="of the planner cells")
    p.add_argument("--episodes", type=int, default=100, help="of a planner cell")
    p.add_argument("extra", nargs="*", help="after --: flags for every cell's command")
    options = p.parse_args(argv)
    options.argv = list(argv)
    return options


def main(argv: Sequence[str] | None = None, run: Run = in_a_process) -> int:
    """Entry point; returns the exit code."""
    options = parse(sys.argv[1:] if argv is None else argv)
    try:
        Ablations(options).execute(run)
    except EgovcpError as error:
        print(f"ablations: error: {error}", file=sys.stderr)
        return error.exit_code
    print((options.output / "ablations.md").read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
