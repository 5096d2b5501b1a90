"""What is done to held-out interactions, and at which moments a filter is then asked."""

from __future__ import annotations

from typing import NamedTuple

from torch_ebip.learning.interruptions import (
    Interrupted,
    Interruption,
    again,
    at_speed,
    idle,
    late,
    pause,
    undisturbed,
)

RECOVERY = 0.5
"""s after an interruption is over, at which a filter is asked."""
SHOWN = 0.82
"""Share of the interaction at which it is asked in any case."""

KINDS: dict[str, Interruption] = {
    "undisturbed": undisturbed,
    "pause of 0.2 to 1 s": pause(0.2, 1.0),
    "pause of 1 to 3 s": pause(1.0, 3.0),
    "pause of 3 to 5 s": pause(3.0, 5.0),
    "idle for 0.5 to 3 s first": idle(0.5, 3.0),
    "first seen at 20 to 60 %": late(0.2, 0.6),
    "started over at 20 to 60 %": again(0.2, 0.6),
    "three times slower": at_speed(1 / 3),
    "twice as slow": at_speed(1 / 2),
    "twice as fast": at_speed(2.0),
    "three times faster": at_speed(3.0),
}
"""By the names that they have in the table."""


class Moment(NamedTuple):
    """When a filter is asked.

    Attributes:
        name: ``during`` an interruption, at the middle of it; `RECOVERY` seconds ``after`` it; at `SHOWN`, ``late``.
        sample: of what it was shown.
        source: which sample of the recording that is.
    """

    name: str
    sample: int
    source: int


def moments(made: Interrupted, length: int, rate: float) -> list[Moment]:
    """When a filter is asked about a recording of ``length`` samples at a rate, Hz, that was interrupted."""
    source, over = made.source.tolist(), made.over
    found = []
    standing = over - next((i for i in range(over) if source[i] == source[over - 1]), over)
    if standing > 2:
        middle = over - standing // 2
        found.append(Moment("during", middle, source[middle]))
    last = max(i for i, s in enumerate(source) if s <= SHOWN * (length - 1))
    after = over + round(RECOVERY * rate)
    if after < last:
        found.append(Moment("after", after, source[after]))
    return [*found, Moment("late", last, source[last])]
