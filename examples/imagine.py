"""Let a trained world model imagine the consequences of two actions, and print Q.

    python examples/imagine.py POLICY DATASET

The episodes of DATASET must be of the policy's robot and low-level controller.
"""

from __future__ import annotations

import argparse

import torch

from egovcp.artifact import load_artifact
from egovcp.data import open_dataset

STEPS = 8


@torch.inference_mode()
def main(policy: str, dataset: str) -> None:
    model = load_artifact(policy).world_model
    episode = next(iter(open_dataset(dataset)))
    depth = torch.tensor(episode.depth.astype("int32"))
    state, actions = torch.tensor(episode.state), torch.tensor(episode.action)

    # Filter the recorded observations: posterior state (h, z) of the last one.
    carry = model.initial(1)
    for t in range(len(depth) - STEPS):
        sent = actions[t - 1 : t] if t else torch.zeros_like(actions[:1])
        start = torch.tensor([t == 0])
        carry = model.observe(carry, sent, depth[t : t + 1], state[t : t + 1], start)

    # Imagine: the same state under two constant actions.
    for name, action in (("the neutral pose", 0.0), ("the upper end of every action", 1.0)):
        plan = torch.full_like(actions[:1], action)
        imagined = carry
        print(f"{name}: Q = {float(model.value(imagined, plan)):+.4f}")
        for _ in range(STEPS):
            imagined = model.imagine(imagined, plan)
        image, _ = model.decode(imagined)
        seen = image[image > 0]
        nearest = f"{float(seen.min()):.2f} m" if len(seen) else "nothing in range"
        print(f"  nearest pixel after {STEPS} steps: {nearest}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", help="folder, Hub id, or contact, which ships with egovcp")
    parser.add_argument("dataset", help="folder or Hub id")
    args = parser.parse_args()
    main(args.policy, args.dataset)
