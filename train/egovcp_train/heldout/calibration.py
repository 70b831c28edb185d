"""Does Q mean what it says?"""

from __future__ import annotations

from torch import Tensor

_FLAT = 1e-12  # variance, units of return squared, of what does not vary


def calibration(value: Tensor, target: Tensor) -> dict[str, float | int | None]:
    """Q against the Monte Carlo return, (n,) each.

    Returns:
        rows; bias, mean of Q - return; r2, the share of the return's variance that Q explains (as
        it stands, so below 0 if the mean is a better guess); slope, regression of the return on Q
        (1: calibrated, above: Q is too timid). None where rows or spread are missing.
    """
    out: dict[str, float | int | None] = {
        "rows": target.numel(),
        "bias": None,
        "r2": None,
        "slope": None,
    }
    if target.numel() == 0:
        return out
    value, target = value.double(), target.double()
    out["bias"] = float((value - target).mean())
    spread = float(target.var(correction=0))
    if spread > _FLAT:
        out["r2"] = 1 - float((value - target).square().mean()) / spread
    centred = value - value.mean()
    if float(centred.square().mean()) > _FLAT:
        out["slope"] = float((centred * target).mean() / centred.square().mean())
    return out
