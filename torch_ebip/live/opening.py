"""How a session finds its beginning, and notices a clock that does not count seconds."""

from __future__ import annotations

import math
from collections import deque
from statistics import median
from typing import Any

FIRST_SAMPLE = "first sample"
"""A session that starts at the earliest time within a window of the first arrival."""
_UNITS = (("milliseconds", 1e3, 1e11), ("microseconds", 1e6, 1e14), ("nanoseconds", 1e9, 1e17))
"""How many of them a second has, and from what size on a time since 1970 is counted in them."""

MOST = 10_000
"""Samples that are kept until the start is certain."""


class Opening:
    """The first samples of a session: until a window has passed, an earlier one may still turn out to be the first.

    Which one it is does not depend on the order in which samples arrive within the window.

    Args:
        window: seconds.

    Attributes:
        start: time of phase 0, s; None before the first sample.
        pushes: those there were so far, the last `MOST`: number of the sensor, values, time.
    """

    def __init__(self, window: float) -> None:
        self.window = window
        self.start: float | None = None
        self.pushes: deque[tuple[int, Any, float]] = deque(maxlen=MOST)
        self._first = math.nan

    def add(self, number: int, values: Any, moment: float, usable: bool) -> bool:
        """Take note of a sample; whether the start is another one now.

        Args:
            number: of the sensor.
            values: of the sample, in memory of their own.
            moment: when it was taken, s; NaN if that is not known.
            usable: whether the sample says anything: the others do not begin an interaction.
        """
        self.pushes.append((number, values, moment))
        if not usable:
            return False
        if self.start is None:
            self.start = self._first = moment
            return True
        if self._first - self.window <= moment < self.start:
            self.start = moment
            return True
        return False

    def over(self, newest: float) -> bool:
        """Whether nothing that counts can come any more, once something was measured or asked at this time, s."""
        return self.start is not None and newest > self._first + self.window


class Clock:
    """Looks at the times of samples: whether they can be seconds.

    Args:
        dt: seconds between samples of the demonstrations.
        sensors: how many there are.
    """

    def __init__(self, dt: float, sensors: int) -> None:
        self._dt = dt
        self._last = [math.nan] * sensors
        self._gaps: list[deque[float]] = [deque(maxlen=5) for _ in range(sensors)]
        self._sizes: list[deque[float]] = [deque(maxlen=3) for _ in range(sensors)]

    def see(self, number: int, moment: float) -> None:
        """A sample of a sensor was taken at this time, s, if it is one."""
        if not math.isfinite(moment):
            return
        self._sizes[number].append(abs(moment))
        gap = moment - self._last[number]
        if gap > 0:
            self._gaps[number].append(gap)
        self._last[number] = moment

    def guess(self, now: float | None) -> str | None:
        """What times seem to be counted in, if not in seconds: by their size, or by how far samples are apart.

        One sample may have any time; a sensor whose last ones agree has a clock.

        Args:
            now: the present, as it was said, s.
        """
        sizes = [min(sizes) for sizes in self._sizes if len(sizes) == sizes.maxlen]
        largest = max([0.0 if now is None else abs(now), *sizes])
        found = [name for name, _, least in _UNITS if largest >= least]
        if found:
            return found[-1]
        for gaps in self._gaps:
            if len(gaps) == gaps.maxlen:
                ratio = median(gaps) / self._dt
                for name, many, _ in _UNITS:
                    if 0.3 * many <= ratio <= 3 * many:
                        return name
        return None
