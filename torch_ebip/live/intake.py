"""What sensors send: checked, sorted into ticks, and kept for as long as it may still matter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from torch_ebip.interaction.bounds import demonstrated_range
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.surprise_memory import STATES

Array = npt.NDArray[np.float64]


@dataclass
class SensorReport:
    """What became of what a sensor sent, counted in samples (a vector of all its DoFs).

    Attributes:
        accepted: used, at least in part, or still to be used.
        nan, infinite, out_of_range: samples with such a value; the values are refused, the rest of the sample is not.
        malformed: not a vector of as many numbers as the sensor has DoFs, or without a time.
        late: older than the window.
        early: from before the interaction, or too far ahead of it for any clock.
        frozen: ticks at which the sensor said the same for too long.
        last: time of the newest sample that was accepted, s; minus infinity if there is none.
        state: "ok", "suspect" or "rejected", by how surprising it was when it was filtered last; see
            `InteractionSurprise`.
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


class Ranges(NamedTuple):
    """What a DoF may say, [D] each, units of the DoFs."""

    low: Array
    high: Array


def training_ranges(primitive: InteractionPrimitive, margin: float) -> Ranges:
    """From the least to the largest value of any demonstration, widened by ``margin`` times what lies between.

    Residuals count too: five standard deviations on either side before it is widened.
    """
    least, most = demonstrated_range(primitive)
    noise = 5 * primitive.residual_variance.sqrt()
    low, high = ((value.double().cpu().numpy()) for value in (least - noise, most + noise))
    return Ranges(low - margin * (high - low), high + margin * (high - low))


@dataclass
class Freshness:
    """Which sensors repeat themselves, which were used when, what failed: part of what is wound back.

    Attributes:
        values: [D], what each DoF said last; NaN if nothing.
        since: int64 [M], the tick since which each modality has said the same.
        used: int64 [M], the tick at which each modality was used last; -1 if never.
        frozen: int64 [M], how often each was refused.
        still: bool [M], whether what each said last was.
        failed: how many ticks the filter could not take in.
    """

    values: Array
    since: npt.NDArray[np.int64]
    used: npt.NDArray[np.int64]
    frozen: npt.NDArray[np.int64]
    still: npt.NDArray[np.bool_]
    failed: int = 0

    def copy(self) -> Freshness:
        """Of its own memory."""
        counts = self.since.copy(), self.used.copy(), self.frozen.copy()
        return Freshness(self.values.copy(), *counts, self.still.copy(), self.failed)


@dataclass
class _Slot:
    """What arrived for one tick: values [D], and for each modality how far from the tick and when it was taken."""

    values: Array
    tick: int = -1
    taken: dict[int, tuple[float, float]] = field(default_factory=dict)


class Intake:
    """A ring of ticks, each with at most one sample of every modality: the one that was taken nearest to the tick.

    Which that is does not depend on the order of arrival.

    Args:
        columns: the slice of each modality's DoFs, M of them.
        ranges: see `training_ranges`.
        start, dt: tick k is at start + k dt, s.
        behind, ahead: how many ticks before and after the newest tick filtered are kept.
    """

    def __init__(
        self, columns: list[slice], ranges: Ranges, start: float, dt: float, behind: int, ahead: int
    ) -> None:
        self.columns, self.ranges, self.start, self.dt = columns, ranges, start, dt
        self.behind, self.ahead = behind, ahead
        self.reports = [SensorReport() for _ in columns]
        self._newest = [(-math.inf, False)] * len(columns)
        D = len(ranges.low)
        self._ring = [_Slot(np.full(D, np.nan)) for _ in range(behind + ahead + 2)]
        self._nothing = np.full(D, np.nan)

    def put(self, modality: int, values: Any, time: Any, head: int) -> int | None:
        """Store a sample if it can be used.

        Args:
            modality: number of the sensor.
            values: [k] numbers, units of the DoFs; anything else is counted as malformed.
            time: when it was taken, s.
            head: newest tick that was filtered.

        Returns:
            The tick that it changes, or None.
        """
        report, columns = self.reports[modality], self.columns[modality]
        vector = as_vector(values, columns.stop - columns.start)
        moment = as_number(time)
        if vector is None or not math.isfinite(moment):
            report.malformed += 1
            return None
        missing = np.isnan(vector).all()
        vector = self._plausible(vector, columns, report)
        impossible = bool(np.isnan(vector).all() and not missing)
        self._newest[modality] = max(self._newest[modality], (moment, impossible))
        place = (moment - self.start) / self.dt
        if place < -0.5 or place > head + self.ahead:
            report.early += 1
            return None
        tick = math.floor(place + 0.5)
        if tick <= head - self.behind:
            report.late += 1
            return None
        if np.isnan(vector).all():
            return None
        report.accepted += 1
        report.last = max(report.last, moment)
        slot = self._slot(tick)
        rank = (abs(place - tick), moment)
        old = slot.taken.get(modality)
        if old is not None:
            # Of two samples that claim the same instant the bytes decide: any rule does that has no order in it.
            same = rank == old and vector.tobytes() <= slot.values[columns].tobytes()
            if old < rank or same:
                return None
        slot.taken[modality] = rank
        slot.values[columns] = vector
        return tick

    @property
    def impossible(self) -> list[bool]:
        """Whether all that each modality measured last could not be: infinite, or out of range."""
        return [impossible for _, impossible in self._newest]

    def says_something(self, modality: int, values: Any, time: Any) -> bool:
        """Whether a sample of a sensor has a time and a value that can be; nothing is counted or stored.

        Args:
            modality: number of the sensor.
            values: [k] numbers, units of the DoFs.
            time: when it was taken, s.
        """
        columns = self.columns[modality]
        vector = as_vector(values, columns.stop - columns.start)
        if vector is None or not math.isfinite(as_number(time)):
            return False
        return not bool(np.isnan(self._plausible(vector, columns, SensorReport())).all())

    def at(self, tick: int) -> Array:
        """What was measured at a tick, [D]; NaN where nothing was. Not to be changed."""
        slot = self._ring[tick % len(self._ring)]
        return slot.values if slot.tick == tick else self._nothing

    def fresh(self) -> Freshness:
        """Before anything was said."""
        M = len(self.columns)
        none = np.zeros(M, np.int64)
        return Freshness(self._nothing.copy(), none, np.full(M, -1, np.int64), none.copy(), np.zeros(M, np.bool_))

    def usable(
        self, tick: int, freshness: Freshness, patience: Sequence[float]
    ) -> tuple[Array, npt.NDArray[np.bool_]]:
        """What a tick measured, [D], and what of it, bool [D], comes from sensors that are not frozen.

        Args:
            tick: to look at, one after the other.
            freshness: so far; brought up to date.
            patience: [M] seconds for which each sensor may say the same.
        """
        values = self.at(tick)
        usable = ~np.isnan(values)
        for m, columns in enumerate(self.columns):
            if not usable[columns].any():
                continue
            said, before = values[columns], freshness.values[columns]
            common = usable[columns] & ~np.isnan(before)
            if not common.any() or (said[common] != before[common]).any():
                freshness.since[m] = tick
            before[usable[columns]] = said[usable[columns]]
            freshness.still[m] = (tick - freshness.since[m]) * self.dt > patience[m]
            if freshness.still[m]:
                freshness.frozen[m] += 1
                usable[columns] = False
            else:
                freshness.used[m] = tick
        return values, usable

    def report(self, freshness: Freshness) -> list[SensorReport]:
        """A copy of the counts of each modality."""
        pairs = zip(self.reports, freshness.frozen.tolist(), strict=True)
        return [replace(report, frozen=frozen) for report, frozen in pairs]

    def _plausible(self, vector: Array, columns: slice, report: SensorReport) -> Array:
        """The vector with NaN for what cannot be."""
        missing, infinite = np.isnan(vector), np.isinf(vector)
        with np.errstate(invalid="ignore"):
            outside = ~missing & ~infinite
            outside &= (vector < self.ranges.low[columns]) | (vector > self.ranges.high[columns])
        report.nan += bool(missing.any())
        report.infinite += bool(infinite.any())
        report.out_of_range += bool(outside.any())
        return np.where(infinite | outside, np.nan, vector)

    def _slot(self, tick: int) -> _Slot:
        slot = self._ring[tick % len(self._ring)]
        if slot.tick != tick:
            slot.tick = tick
            slot.values.fill(np.nan)
            slot.taken.clear()
        return slot


def as_vector(values: Any, length: int) -> Array | None:
    """Numbers [length] of whatever a sensor sent; None if it is not that."""
    try:
        vector = np.asarray(values)
        numbers = vector.dtype.kind in "fiu" and vector.shape == (length,)
        return vector.astype(np.float64) if numbers else None
    except Exception:  # an object may raise anything when it is asked for numbers
        return None


def as_number(time: Any) -> float:
    """A float; NaN for what is none."""
    try:
        return float(time)
    except Exception:  # as above
        return math.nan
