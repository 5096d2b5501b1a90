"""Samples of one sensor, taken at times of its own, put onto an even grid."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
How = Literal["linear", "nearest", "sample"]
HOWS: tuple[str, ...] = get_args(How)
USUAL_STEPS = 3.0
"""Of a sensor's own steps, between which samples are joined where nobody says ``max_gap``."""
NEAR = 1e-6
"""s, by which a time may be off a sample and still be it."""


class Ordered(NamedTuple):
    """Stamps in order, each once.

    Attributes:
        times: [T], s.
        values: [T, d].
        backward: how many stamps lay before the one that came before them.
        repeated: how many samples had a stamp that another had; the first of them is kept.
    """

    times: Array
    values: Array
    backward: int
    repeated: int


def ordered(times: Array, values: Array) -> Ordered:
    """Samples in the order of their stamps.

    Args:
        times: [T], s, as they came.
        values: [T, d].
    """
    backward = int((np.diff(times) < 0).sum())
    if backward:
        order = np.argsort(times, kind="stable")
        times, values = times[order], values[order]
    first = np.diff(times, prepend=-np.inf) > 0
    repeated = int((~first).sum())
    return Ordered(times[first], values[first], backward, repeated)


def onto_grid(times: Array, values: Array, grid: Array, max_gap: float, how: How = "linear") -> Array:
    """Values [G, d] at the times of a grid [G], s; NaN where nothing says.

    Args:
        times: [T], s, increasing.
        values: [T, d]; a NaN was not measured and says nothing of its column.
        grid: [G], s, increasing, evenly spaced.
        max_gap: s. ``linear`` joins samples at most so far apart, ``nearest`` takes one at most so far away.
        how: ``sample`` puts each sample where it is nearest to, and NaN elsewhere: slow sensors stay slow.
    """
    found = np.full((len(grid), values.shape[1]), np.nan)
    said = ~np.isnan(values)
    patterns, columns = np.unique(said, axis=1, return_inverse=True)
    for number, pattern in enumerate(patterns.T):
        if pattern.any():
            mine = np.flatnonzero(columns.reshape(-1) == number)
            found[:, mine] = _onto(times[pattern], values[np.ix_(pattern, mine)], grid, max_gap, how)
    return found


def _onto(times: Array, values: Array, grid: Array, max_gap: float, how: How) -> Array:
    after = np.searchsorted(times, grid).clip(0, len(times) - 1)
    before = (after - 1).clip(0)
    since, until = grid - times[before], times[after] - grid
    nearest = np.where(np.abs(since) < np.abs(until), before, after)
    away = np.abs(times[nearest] - grid)
    if how == "linear":
        span = times[after] - times[before]
        share = np.divide(since, span, out=np.zeros_like(span), where=span > 0)
        found: Array = values[before] + share[:, None] * (values[after] - values[before])
        found[(span > max_gap + NEAR) | (since < -NEAR) | (until < -NEAR)] = np.nan
        found[away <= NEAR] = values[nearest[away <= NEAR]]
        return found
    found = values[nearest]
    # A sample goes where it is nearest to, in the middle between two to the later one.
    half = (grid[1] - grid[0]) / 2 if len(grid) > 1 else max_gap
    off = times[nearest] - grid
    found[(away > max_gap) if how == "nearest" else (off < -half - NEAR) | (off >= half - NEAR)] = np.nan
    return found
