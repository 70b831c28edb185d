"""Let a trained world model imagine the consequences of an action, and print Q.

    python examples/imagine.py POLICY DATASET

POLICY is a folder or a Hub id, DATASET a folder or a Hub id of episodes of the same controller.
"""

from __future__ import annotations

import sys

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
    for name, action in (("hands at rest", 0.0), ("both hands up", 1.0)):
        plan = torch.full_like(actions[:1], action)
        imagined = carry
        print(f"{name}: Q = {float(model.value(imagined, plan)):+.4f}")
        for _ in range(STEPS):
            imagined = model.imagine(imagined, plan)
        image, _ = model.decode(imagined)
        print(f"  nearest pixel after {STEPS} steps: {float(image[image > 0].min()):.2f} m")


if __name__ == "__main__":
    main(*sys.argv[1:])
