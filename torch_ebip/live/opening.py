"""How a session finds its beginning, and notices a clock that does not count seconds."""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise

from torch_ebip.live.intake import Sample

FIRST_SAMPLE = "first sample"
"""A session that starts at the earliest time within a window of the first arrival."""
_UNITS = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
"""How many of them a second has."""
_LARGEST = 1e11
"""Seconds since 1970 that no clock shows: the year 5138. In milliseconds it was 1973."""
ENOUGH = 5
"""Samples that agree where a session began; as many others, none of them near, show that it began elsewhere."""
MOST = 10_000
"""Samples that are kept until the start is certain."""


class Opening:
    """The first samples of a session: until a window has passed, an earlier one may still turn out to be the first.

    Which one it is does not depend on the order in which samples arrive within the window.

    Args:
        window: seconds.

    Attributes:
        start: time of phase 0, s; None before the first sample.
        pushes: samples there were so far, the last `MOST`.
    """

    def __init__(self, window: float) -> None:
        self.window = window
        self.start: float | None = None
        self.pushes: deque[Sample] = deque(maxlen=MOST)
        self._first = math.nan

    def add(self, sample: Sample) -> bool:
        """Take note of a sample; whether the start is another one now.

        Args:
            sample: with the time when it was taken, s; one that says nothing does not begin an interaction.
        """
        self.pushes.append(sample)
        moment = sample.time
        if not sample.says:
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


class Units:
    """Looks at the times of samples: whether they can be seconds.

    They cannot where they are too large for any clock, or where a sensor would say something less often than every
    second interaction. A clock that starts near 0, counts in another unit and belongs to a sensor much faster than
    the demonstrations escapes that. One sensor that counts in seconds settles it: then the others are wrong by
    themselves.

    Args:
        dt: seconds between samples of the demonstrations.
        longest: duration of the longest demonstration, s.
        sensors: how many there are.
    """

    def __init__(self, dt: float, longest: float, sensors: int) -> None:
        self._dt, self._longest = dt, longest
        self._times: list[deque[float]] = [deque(maxlen=6) for _ in range(sensors)]

    def see(self, number: int, moment: float) -> None:
        """A sample of a sensor was taken at this time, s, if it is one."""
        if math.isfinite(moment):
            self._times[number].append(moment)

    def guess(self, now: float | None) -> str | None:
        """What times seem to be counted in, if not in seconds.

        Args:
            now: the present, as it was said, s.
        """
        if now is not None and abs(now) >= _LARGEST:
            return self._of_size(abs(now))
        found = [self._of(times) for times in self._times if len(times) > 2]
        return None if None in found or not found else found[0]

    def _of(self, times: deque[float]) -> str | None:
        """What one sensor counts in; None for seconds."""
        size = min(abs(moment) for moment in times)
        gap = min(abs(b - a) for a, b in pairwise(times))
        if len(times) == times.maxlen and gap > 2 * self._longest:
            # The nearest that makes it about as fast as the demonstrations were.
            return min(_UNITS, key=lambda unit: abs(math.log(gap / self._dt / unit[1])))[0]
        return self._of_size(size) if size >= _LARGEST else None

    @staticmethod
    def _of_size(size: float) -> str:
        return _UNITS[0 if size < 1e14 else 1 if size < 1e17 else 2][0]


class Lost:
    """Samples out of reach of the first one: if they agree with each other, it is the first that was wrong.

    Args:
        reach: seconds within which they must lie of each other.
    """

    def __init__(self, reach: float) -> None:
        self._reach = reach
        self._accepted = 0
        self._samples: list[Sample] = []

    def add(self, sample: Sample, accepted: bool) -> list[Sample] | None:
        """Take note of a sample that says something; those to begin again with, once there are enough.

        Args:
            sample: with the time when it was taken, s.
            accepted: whether it was in reach.
        """
        self._accepted += accepted
        if accepted or self._accepted >= ENOUGH:
            return None
        self._samples = [*self._samples[-ENOUGH:], sample]
        times = [known.time for known in self._samples]
        if len(times) <= max(ENOUGH, self._accepted) or max(times) - min(times) > self._reach:
            return None
        samples, self._samples, self._accepted = self._samples, [], 0
        return samples
