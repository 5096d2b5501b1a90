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
from torch_ebip.live.report import SensorReport
from torch_ebip.recordings.angles import TURN

Array = npt.NDArray[np.float64]


class Ranges(NamedTuple):
    """What a DoF may say, [D] each, units of the DoFs, and whether it is an angle, bool [D]: None if none is."""

    low: Array
    high: Array
    angles: npt.NDArray[np.bool_] | None = None


def training_ranges(primitive: InteractionPrimitive, margin: float) -> Ranges:
    """From the least to the largest value of any demonstration, widened by ``margin`` times what lies between.

    Residuals count too: five standard deviations on either side before it is widened.
    """
    least, most = demonstrated_range(primitive)
    noise = 5 * primitive.residual_variance.sqrt()
    low, high = ((value.double().cpu().numpy()) for value in (least - noise, most + noise))
    angles = primitive.layout.angles.numpy()
    return Ranges(low - margin * (high - low), high + margin * (high - low), angles if angles.any() else None)


class Sample(NamedTuple):
    """A sample that was looked at.

    Attributes:
        number: of the sensor.
        values: [k], units of the DoFs, NaN for what cannot be; None without numbers or a time.
        time: when it was taken, s; NaN if that is not known.
        says: whether anything is left of it.
        missing, infinite, outside: whether any value was NaN, infinite, or out of range.
        impossible: whether nothing is left because it cannot be.
    """

    number: int
    values: Array | None
    time: float
    says: bool = False
    missing: bool = False
    infinite: bool = False
    outside: bool = False
    impossible: bool = False


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
        self._limits = [(ranges.low[part].tolist(), ranges.high[part].tolist()) for part in columns]
        # An angle is taken within half a turn of the middle of what was demonstrated, wherever it was wrapped.
        self._turns = [_turns(ranges, part) for part in columns]
        D = len(ranges.low)
        self._ring = [_Slot(np.full(D, np.nan)) for _ in range(behind + ahead + 2)]
        self._nothing = np.full(D, np.nan)

    def look(self, modality: int, vector: Array | None, moment: float) -> Sample:
        """What can be used of a sample; nothing is counted or stored.

        Args:
            modality: number of the sensor.
            vector: [k] numbers, units of the DoFs, in memory of their own; None if it was not that.
            moment: when it was taken, s; NaN if that is not known.
        """
        if vector is None or not math.isfinite(moment):
            return Sample(modality, None, moment)
        low, high = self._limits[modality]
        turns = self._turns[modality]
        if turns is not None:
            vector = vector - np.nan_to_num(np.round((vector - turns) / TURN), posinf=0, neginf=0) * TURN
        values = vector.tolist()
        for least, value, most in zip(low, values, high, strict=True):
            if not least <= value <= most:
                break
        else:
            return Sample(modality, vector, moment, True)
        missing = infinite = outside = impossible = says = False
        for i, value in enumerate(values):
            if low[i] <= value <= high[i]:
                says = True
                continue
            if math.isnan(value):
                missing = True
                continue
            impossible = True
            if math.isinf(value):
                infinite = True
            else:
                outside = True
            values[i] = math.nan
        return Sample(modality, np.array(values), moment, says, missing, infinite, outside, impossible and not says)

    def refuse(self, sample: Sample) -> None:
        """Count a sample that is ahead of every other clock."""
        self._count(sample)
        self.reports[sample.number].early += 1

    def put(self, sample: Sample, head: int) -> int | None:
        """Count a sample, and store it if it can be used.

        Args:
            sample: see `look`.
            head: newest tick that was filtered.

        Returns:
            The tick that it changes, or None.
        """
        report, columns = self.reports[sample.number], self.columns[sample.number]
        self._count(sample)
        vector, moment = sample.values, sample.time
        if vector is None:
            return None
        self._newest[sample.number] = max(self._newest[sample.number], (moment, sample.impossible))
        place = (moment - self.start) / self.dt
        if place < -0.5 or place > head + self.ahead:
            report.early += 1
            return None
        tick = math.floor(place + 0.5)
        if tick <= head - self.behind:
            report.late += 1
            return None
        if not sample.says:
            return None
        report.accepted += 1
        report.last = max(report.last, moment)
        slot = self._slot(tick)
        rank = (abs(place - tick), moment)
        old = slot.taken.get(sample.number)
        if old is not None:
            # Of two samples that claim the same instant the bytes decide: any rule does that has no order in it.
            same = rank == old and vector.tobytes() <= slot.values[columns].tobytes()
            if old < rank or same:
                return None
        slot.taken[sample.number] = rank
        slot.values[columns] = vector
        return tick

    @property
    def impossible(self) -> list[bool]:
        """Whether all that each modality measured last could not be: infinite, or out of range."""
        return [impossible for _, impossible in self._newest]

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

    def _count(self, sample: Sample) -> None:
        """What is wrong with it."""
        report = self.reports[sample.number]
        report.malformed += sample.values is None
        report.nan += sample.missing
        report.infinite += sample.infinite
        report.out_of_range += sample.outside

    def _slot(self, tick: int) -> _Slot:
        slot = self._ring[tick % len(self._ring)]
        if slot.tick != tick:
            slot.tick = tick
            slot.values.fill(np.nan)
            slot.taken.clear()
        return slot


def _turns(ranges: Ranges, part: slice) -> Array | None:
    """Middles of the ranges of angles, rad, NaN for what is none; None if none of these DoFs is."""
    if ranges.angles is None or not ranges.angles[part].any():
        return None
    return np.where(ranges.angles[part], (ranges.low[part] + ranges.high[part]) / 2, np.nan)


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
