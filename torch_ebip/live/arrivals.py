"""A queue in front of a session: a sensor's thread leaves its sample there and goes on."""

from __future__ import annotations

from queue import SimpleQueue
from typing import NamedTuple

from torch_ebip.live.intake import Array

MOST_WAITING = 4096
"""Samples that may wait; beyond that who brings one helps to take some in."""
HELP = 2
"""How many: more than one, so that the queue becomes shorter."""


class Arrival(NamedTuple):
    """A sample as it came.

    Attributes:
        number: of the sensor.
        values: [k], units of its DoFs; None if it was not that.
        time: when it was taken, s; NaN if that is not known.
    """

    number: int
    values: Array | None
    time: float


class Arrivals:
    """Samples in the order in which they came; putting one there never waits for anybody."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[Arrival] = SimpleQueue()
        self.put = self._queue.put

    def __len__(self) -> int:
        return self._queue.qsize()

    @property
    def many(self) -> bool:
        """Whether nobody has looked for so long that the queue should become no longer."""
        return self._queue.qsize() > MOST_WAITING

    def take(self, most: int | None = None) -> list[Arrival]:
        """What is there now, at most so many. By one thread at a time; what comes meanwhile is left for the next."""
        count = self._queue.qsize()
        return [self._queue.get_nowait() for _ in range(count if most is None else min(count, most))]
