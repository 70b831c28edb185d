"""Collect, train and evaluate in Python, with the options of `make quickstart`.

    python examples/quickstart.py OUTPUT_DIR

With the default sizes this takes about 15 minutes on two cores.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from egovcp_collect.collect import main as collect
from egovcp_deploy.evaluate import main as evaluate
from egovcp_train.train import main as train


def run(output: Path, episodes: int, scenarios: int, options: list[str]) -> float:
    """Return the planner's success rate over new scenarios of the ball task; exits with the code of
    a command that fails. ``options`` are further ones of the training."""
    data, policy = output / "dataset", output / "policy"
    root, recipe = f"--dataset.root={data}", ["--preset=laptop", "--seed=0"]
    if code := collect(["--task=ball", root, f"--episodes={episodes}", "--seed=0"]):
        raise SystemExit(code)
    if code := train([root, f"--output_dir={policy}", *recipe, *options]):
        raise SystemExit(code)
    if code := evaluate(
        [
            "--task=ball",
            f"--policy.path={policy / 'checkpoints/last/pretrained_model'}",
            f"--episodes={scenarios}",
            f"--output_dir={output / 'eval'}",
            "--controllers=planner,hold",
        ]
    ):
        raise SystemExit(code)
    table = json.loads((output / "eval/eval.json").read_text())
    return float(table["ball"]["planner"]["success_rate"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output_dir", type=Path)
    parser.add_argument("--episodes", type=int, default=4000, help="throws to collect")
    parser.add_argument("--scenarios", type=int, default=80, help="throws to evaluate on")
    args, options = parser.parse_known_args()
    rate = run(args.output_dir, args.episodes, args.scenarios, options)
    print(f"the planner blocks {rate:.0%} of the balls")


if __name__ == "__main__":
    main()
