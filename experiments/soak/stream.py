"""Measurements without end: interactions one after the other, with everything that goes wrong with sensors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_ebip import Demonstrations

MISSING = 0.2
"""How often a sensor has no value for a sample."""
SILENCE = 0.005
"""How often, a sample, a sensor falls silent for longer: up to a second, evenly."""
JITTER = 0.5
"""By which share of itself the time between samples varies at most, evenly."""


class Sample(NamedTuple):
    """One sample.

    Attributes:
        first: whether an interaction begins with it.
        dt: seconds since the one before.
        y: [D], units of the DoFs.
        observed: bool [D].
    """

    first: bool
    dt: float
    y: Tensor
    observed: Tensor


def stream(demonstrations: Demonstrations, sensors: Tensor, seed: int) -> Iterator[Sample]:
    """Interactions in an order of their own, again and again, from the first sample of each to the last.

    Args:
        demonstrations: what is shown.
        sensors: bool [D], the DoFs that are measured.
        seed: of the order, the gaps and the times.
    """
    draws = np.random.default_rng(seed)
    layout, rate = demonstrations.layout, demonstrations.rate
    shown = [part for name in layout.names if bool(sensors[part := layout.slice(name)].any())]
    while True:
        values = demonstrations[int(draws.integers(len(demonstrations)))]
        present = _present(len(values), len(shown), rate, draws)
        observed = torch.zeros(values.shape, dtype=torch.bool)
        for column, part in enumerate(shown):
            observed[:, part] = torch.from_numpy(present[:, column : column + 1]) & sensors[part]
        observed &= ~values.isnan()
        values = torch.where(observed, values, torch.nan)
        steps = (1 + JITTER * draws.uniform(-1, 1, len(values))) / rate
        for t, dt in enumerate(steps.tolist()):
            yield Sample(t == 0, dt, values[t], observed[t])


def _present(length: int, count: int, rate: float, draws: np.random.Generator) -> np.ndarray:
    """Which of ``count`` sensors have a value, bool [length, count]."""
    present = draws.uniform(size=(length, count)) >= MISSING
    for at, sensor in np.argwhere(draws.uniform(size=(length, count)) < SILENCE):
        present[at : at + int(draws.integers(1, int(rate) + 1)), sensor] = False
    return present
