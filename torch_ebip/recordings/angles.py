"""Angles, which are where they were after a whole turn: made continuous on the way in, wrapped on the way out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

TURN = 2 * math.pi


def wrapped(angles: Tensor) -> Tensor:
    """[...] rad, in (-pi, pi].

    Example:
        >>> wrapped(torch.tensor([0.5, 3.5])).tolist()[0]
        0.5
    """
    return -(math.pi - angles).remainder(TURN) + math.pi


def continuous(angles: Tensor, centre: Tensor) -> Tensor:
    """[T, k] rad: no step of more than half a turn, the first of each column within half a turn of ``centre`` [k].

    What was not measured, NaN, is passed over. What is continuous already is not changed, to the bit.

    Args:
        angles: [T, k], rad.
        centre: [k], rad.
    """
    found = angles.clone()
    for k in range(angles.shape[1]):
        said = ~angles[:, k].isnan()
        values = angles[said, k]
        if not len(values):
            continue
        steps = torch.diff(values, prepend=centre[k : k + 1].to(values))
        turns = torch.round((steps - wrapped(steps)) / TURN).cumsum(0)
        found[said, k] = values - TURN * turns
    return found


def centre_of(trajectories: Sequence[Tensor], column: int) -> float:
    """rad, in (-pi, pi]: the circular mean of the first angle that each trajectory [T, D] measured; 0 if none did."""
    first = []
    for trajectory in trajectories:
        said = trajectory[:, column]
        said = said[~said.isnan()]
        first += said[:1].double().tolist()
    if not first:
        return 0.0
    angles = torch.tensor(first, dtype=torch.float64, device="cpu")
    return math.atan2(float(angles.sin().mean()), float(angles.cos().mean()))
