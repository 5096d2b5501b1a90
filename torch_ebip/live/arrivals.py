"""A queue in front of a session: a sensor's thread leaves its sample there and goes on."""

from __future__ import annotations

from queue import SimpleQueue
from typing import Any, NamedTuple

import numpy as np

from torch_ebip.live.intake import as_vector

MOST_WAITING = 4096
"""Samples that may wait; beyond that who brings one helps to take some in."""
HELP = 2
"""How many: more than one, so that the queue becomes shorter."""


class Arrival(NamedTuple):
    """A sample as it came, not yet looked at.

    Attributes:
        number: of the sensor.
        values: whatever it sent, in memory of its own.
        time: when it was taken, s; NaN if that is not known.
    """

    number: int
    values: Any
    time: float


def kept(values: Any, length: int) -> Any:
    """What a sensor sent, so that it may write into its buffer again; as little work as that takes.

    Args:
        values: anything.
        length: how many numbers it should be.
    """
    kind = type(values)
    if kind is np.ndarray:
        return values.copy() if values.shape == (length,) else None
    if kind is tuple or kind is list:
        return tuple(values) if len(values) == length else None
    return as_vector(values, length)


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
