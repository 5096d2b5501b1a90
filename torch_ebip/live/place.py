"""Where an interaction is at the present, read once from a filter for all that is asked at that moment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from torch_ebip.interaction.pace.waiting import Waits
from torch_ebip.live.engine import Engine


class Place(NamedTuple):
    """The phase at the present, and how it goes on.

    Attributes:
        phase: at the present; below 0 and beyond 1 included, unless it is that of a circle.
        velocity: 1/s, of who goes on.
        waits: whether the person stands still; None where nobody looks.
        since: seconds since the filter's last tick.
        periodic: whether the phase is that of a circle.
    """

    phase: float
    velocity: float
    waits: Waits | None
    since: float
    periodic: bool

    @classmethod
    def of(cls, engine: Engine, since: float, periodic: bool) -> Place:
        """As the filter has it, so many seconds after its last tick.

        Args:
            engine: the filter.
            since: seconds since its last tick.
            periodic: whether the phase is that of a circle.
        """
        phase, velocity = engine.clock()
        waits = engine.waits()
        gone = since if waits is None else float(waits.gone(torch.as_tensor([since]).to(waits.rest)))
        return cls(phase + velocity * gone, velocity, waits, since, periodic)

    @property
    def within(self) -> float:
        """The phase within 0 and 1."""
        return self.phase % 1.0 if self.periodic else min(max(self.phase, 0.0), 1.0)

    @property
    def time_to_end(self) -> float:
        """Seconds until phase 1, of who stands still until they go on, too; infinite where there is no end."""
        if self.periodic or self.velocity <= 0:
            return math.inf
        rest = 0.0 if self.waits is None else float(self.waits.rest)
        return (1 - self.within) / self.velocity + rest

    def finished(self, dt: float) -> bool:
        """Whether the interaction is over: nearer to its end than half a tick of dt s. What repeats never is."""
        return not self.periodic and self.within >= 1 - max(self.velocity, 0.0) * dt / 2

    def ahead(self, horizons: Sequence[float]) -> list[float]:
        """The phases so many seconds ahead; infinity is the end."""
        gone = list(horizons)
        if self.waits is not None:
            gone = self.waits.gone(torch.as_tensor(gone).to(self.waits.rest)).tolist()
        phases = [1.0 if math.isinf(seconds) else self.phase + self.velocity * seconds for seconds in gone]
        return phases if self.periodic else [min(max(phase, 0.0), 1.0) for phase in phases]
