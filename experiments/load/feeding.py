"""Sensors in threads of their own: what each of their pushes takes, beside a bare queue's."""

from __future__ import annotations

import threading
import time
from queue import SimpleQueue

import numpy as np
import torch

from torch_ebip import Demonstrations, InteractionSession


class Feeder(threading.Thread):
    """One sensor's driver: a sample every millisecond or so, into the session and into a bare queue.

    Args:
        session: to push to.
        name: of the sensor.
        shown: interactions, shown one after the other.
        rate: samples a second.
        seconds: how long at most.
        began: monotonic time at which the interaction that is shown began, and which it is; changed from outside.

    Attributes:
        push, bare: what each took, s, in order.
    """

    def __init__(
        self, session: InteractionSession, name: str, shown: Demonstrations, rate: float, seconds: float,
        began: list[tuple[float, int]],
    ) -> None:  # fmt: skip
        super().__init__(daemon=True)
        part = shown.layout.slice(name)
        self._session, self._sensor, self._began = session, name, began
        self._values = [values[:, part].double().numpy() for values in shown]
        self._step, self._rate, count = 1 / rate, shown.rate, int(seconds * rate) + 1
        self.push, self.bare = np.full(count, np.nan), np.full(count, np.nan)
        self.queue: SimpleQueue[tuple[str, object, float]] = SimpleQueue()
        self.stop = threading.Event()

    def run(self) -> None:
        """Until `stop`, or all is measured."""
        due = time.monotonic()
        for i in range(len(self.push)):
            due += self._step
            wait = due - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            if self.stop.is_set():
                return
            now = time.monotonic()
            began, which = self._began[0]
            values = self._values[which]
            row = values[min(int((now - began) * self._rate), len(values) - 1)]
            sample = (self._sensor, row, now)
            # In turn, so that neither finds what the other has warmed.
            for first in (i % 2, 1 - i % 2):
                start = time.perf_counter()
                if first:
                    self._session.push(*sample)
                else:
                    self.queue.put(sample)
                (self.push if first else self.bare)[i] = time.perf_counter() - start


def alone(
    session: InteractionSession, shown: Demonstrations, names: list[str], polls: int, rate: float, late: int = 0
) -> np.ndarray:
    """What a forecast takes when nothing else goes on, s, [polls]; the first sensor may be so many samples late."""
    taken, start, which, tick = np.empty(polls), 0.0, 0, 0
    for i in range(polls):
        values = shown[which]
        now = start + tick / rate
        for name in names:
            at = tick - late * (name == names[0])
            if at >= 0:
                row = values[min(int(at / rate * shown.rate), len(values) - 1)]
                session.push(name, row[shown.layout.slice(name)], start + at / rate)
        began = time.perf_counter()
        told = session.forecast(0.1, now)
        taken[i] = time.perf_counter() - began
        assert bool(torch.isfinite(told.mean).all())
        tick += 1
        if tick / rate > len(values) / shown.rate:
            start, which, tick = now + 1 / rate, (which + 1) % len(shown), 0
            session.restart()
    return taken
