"""What a session expects."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from torch import Tensor

from torch_ebip.common.arguments import as_number
from torch_ebip.common.brief import brief


class SessionForecast(NamedTuple):
    """What a session expects.

    Attributes:
        time: the present, s.
        phase: where in the interaction it is now, 0 to 1.
        time_to_end: seconds until phase 1; infinite if the interaction stands still, or has no end.
        dofs: names of the controlled DoFs, D_c of them.
        mean, deviation: [D_c], or [P, D_c] for P horizons: expected values and their standard deviations.
        stale: names of the sensors of which nothing was used for a while, or ever.
        horizon: seconds from the present that were asked for, P of them; empty for the end alone.
        labels: probability of each of the labelled interactions, by name; empty where there are none.
        familiarity: 0 to 1, the chance of a surprise as large as the largest so far in an interaction like those
            demonstrated; below .01 hardly any of those is. NaN where it was not calibrated, see `learn`.
        states: of each sensor "ok", "suspect" (it counts less) or "rejected" (nothing, until it agrees again;
            also where the last of it was refused: out of range, or the same for too long).
        finished: whether the interaction is over; what comes after needs `InteractionSession.restart`.
        notes: what is wrong with time; see `SessionReport`.
    """

    time: float
    phase: float
    time_to_end: float
    dofs: tuple[str, ...]
    mean: Tensor
    deviation: Tensor
    stale: tuple[str, ...]
    horizon: tuple[float, ...] = ()
    labels: Mapping[str, float] = MappingProxyType({})
    familiarity: float = math.nan
    states: Mapping[str, str] = MappingProxyType({})
    finished: bool = False
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return brief(self)


def as_present(now: float | None) -> float | None:
    """A float of a time in s, whatever library the number is from; None for None.

    Raises:
        ValueError: it is no number.
    """
    try:
        return None if now is None else float(now)
    except (OverflowError, TypeError, ValueError) as error:
        raise ValueError(f"now must be a finite time in seconds, got {str(now)[:40]}") from error


MOST_POINTS = 10_000
"""Of a way that is sampled."""


def sampled(end: float, rate: float) -> list[float]:
    """Seconds from now, from one step of a controller on up to an end, s, and the end itself.

    Args:
        end: s, of the way.
        rate: Hz, of the controller.

    Raises:
        ValueError: a rate that is not positive, or more than `MOST_POINTS`.
    """
    rate = as_number("rate", rate, 0, above=True, of="of points a second")
    points_there = max(end, 0.0) * rate * (1 + 1e-9)
    if not points_there <= MOST_POINTS:
        raise ValueError(f"{end:g} s at {rate:g} Hz are {points_there:g} points, expected at most {MOST_POINTS}")
    count = math.floor(points_there)
    points = [i / rate for i in range(1, count + 1)]
    return points if points and end - points[-1] < 1e-6 else [*points, max(end, 0.0)]
