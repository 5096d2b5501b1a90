"""What a session says of what it was sent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from torch_ebip.interaction.surprise_memory import STATES


@dataclass
class SensorReport:
    """What became of what a sensor sent, counted in samples (a vector of all its DoFs).

    Attributes:
        accepted: used, at least in part, or still to be used.
        nan, infinite, out_of_range: samples with such a value; the values are refused, the rest of the sample is not.
        malformed: not a vector of as many numbers as the sensor has DoFs, or without a time.
        late: older than the window.
        early: from before the interaction, or ahead of every other clock.
        frozen: ticks at which the sensor said the same for too long.
        last: time of the newest sample that was accepted, s; minus infinity if there is none.
        state: "ok", "suspect" or "rejected", by how surprising it was when it was filtered last; see
            `InteractionSurprise`.
        backwards: taken before the sample that had arrived last.
        jumps: how often its clock jumped.
        jumped: by how much the last time, s; also where no sensor said anything for so long.
        lateness: for how long its samples are under way: so long after the newest of any sensor, and after ``now``,
            each of its latest samples arrived at least, s; 0 for a sensor in step.
    """

    accepted: int = 0
    nan: int = 0
    infinite: int = 0
    out_of_range: int = 0
    malformed: int = 0
    late: int = 0
    early: int = 0
    frozen: int = 0
    last: float = -math.inf
    state: str = STATES[0]
    # Depend on the order of arrival, and are left out where two reports are compared.
    backwards: int = field(default=0, compare=False)
    jumps: int = field(default=0, compare=False)
    jumped: float = field(default=0.0, compare=False)
    lateness: float = field(default=0.0, compare=False)


class SessionReport(dict[str, SensorReport]):
    """The report of each sensor, by name, and what is wrong with time.

    Args:
        sensors: reports by name.
        notes: one sentence each.

    Attributes:
        notes: what was noticed about clocks and lateness, and whether the interaction is over; empty if all is well.
    """

    def __init__(self, sensors: Mapping[str, SensorReport], notes: tuple[str, ...] = ()) -> None:
        super().__init__(sensors)
        self.notes = notes

    def __repr__(self) -> str:
        return "\n".join([*(f"{name}: {report}" for name, report in self.items()), *self.notes])
