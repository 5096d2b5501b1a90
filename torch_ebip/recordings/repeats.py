"""How long sensors say the same to the last digit while nothing is wrong with them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torch_ebip.recordings.demonstrations import Demonstrations


def longest_repeats(demonstrations: Demonstrations) -> Tensor:
    """For how long each modality repeats itself at most, over all demonstrations: [M] seconds on the CPU.

    A modality repeats itself while none of its measured values differs from the one before. One that says the same
    throughout a demonstration, of at least two samples, may do so for ever: infinity.
    """
    longest = [0.0 for _ in demonstrations.layout.names]
    for trajectory in demonstrations:
        values = trajectory.double().cpu().numpy()
        for m, name in enumerate(demonstrations.layout.names):
            part = values[:, demonstrations.layout.slice(name)]
            spoke = np.flatnonzero(~np.isnan(part).all(-1))
            if len(spoke) < 2:
                continue
            part = part[spoke]
            rows = np.arange(len(part))[:, None]
            last = np.maximum.accumulate(np.where(np.isnan(part), -1, rows), axis=0)  # where each was measured last
            before = np.take_along_axis(part, np.maximum(last[:-1], 0), axis=0)
            with np.errstate(invalid="ignore"):
                differs = (last[:-1] >= 0) & ~np.isnan(part[1:]) & (part[1:] != before)
            common = ((last[:-1] >= 0) & ~np.isnan(part[1:])).any(-1)
            changes = np.flatnonzero(differs.any(-1) | ~common) + 1
            if len(changes) == 0:
                longest[m] = np.inf
                continue
            starts = np.concatenate([[0], changes])
            ends = np.concatenate([changes - 1, [len(part) - 1]])
            samples = (spoke[ends] - spoke[starts]).max()
            longest[m] = max(longest[m], float(samples) / demonstrations.rate)
    return torch.tensor(longest, dtype=torch.float64, device="cpu")
