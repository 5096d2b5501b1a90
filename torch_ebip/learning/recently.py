"""What was seen of late of interactions that are filtered thinned: of all samples, not of every k-th.

A filter that is shown every k-th sample knows where an interaction is as well as one that sees all of them; how a
hand moves it does not.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.filtering.updates.recent import Recent
from torch_ebip.filtering.updates.weighting import Seen


def recent_sums(
    recent: Recent, y: Tensor, observed: Tensor, steps: Tensor, dt: float, counts: Tensor | None = None
) -> Tensor:
    """[B, K, 5, D], what is remembered after some samples.

    Args:
        recent: over k of the D DoFs.
        y: [B, T, k], units of the DoFs; ignored where not observed.
        observed: bool [B, T, k].
        steps: int64 [B, K], after which samples.
        dt: seconds between samples.
        counts: [B, T, k], how far each value was believed; default: all.
    """
    sums = recent.start(y)
    found = sums.new_zeros(*steps.shape, *sums.shape[-2:])
    seconds = y.new_tensor(dt)
    nothing = y.new_zeros(1, 1)
    for t in range(int(steps.max()) + 1):
        if t:
            sums = recent.forget(sums, seconds)
        believed = None if counts is None else counts[:, t]
        sums = recent.learn(sums, Seen(y[:, t], observed[:, t], believed, None, nothing, nothing[0], None))
        here = steps == t
        if bool(here.any()):
            found = torch.where(here[..., None, None], sums.unsqueeze(1), found)
    return found
