"""The ticks of a session: what arrived for each, how far the filter is, and the way back when something is late."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from torch_ebip.common.modules import sharing
from torch_ebip.interaction.bounds import Bounds
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.surprise_memory import STATES, state_of
from torch_ebip.live.engine import make_engine
from torch_ebip.live.intake import Array, Freshness, Intake, SensorReport, as_vector, training_ranges
from torch_ebip.live.opening import Clock, Lost, Opening
from torch_ebip.live.settings import SessionSettings, patience_of

TOLERANCE = 1e-3
"""Ticks by which a time may be short of a tick and still be it: clocks that count from 1970 round to microseconds."""


class Timeline:
    """One filter on ticks as far apart as the demonstrations' samples, fed by M sensors. See `InteractionSession`.

    Args:
        filter: of the primitive.
        primitive: of the demonstrations.
        sensors: names of modalities, M of them.
        settings: how to treat them.

    Attributes:
        ticks: how many the filter was led through so far, repeated ones included.
    """

    def __init__(
        self,
        filter: InteractionFilter,
        primitive: InteractionPrimitive,
        sensors: Sequence[str],
        settings: SessionSettings,
    ) -> None:
        layout, dt = primitive.layout, filter.dt
        self.settings, self.dt = settings, dt
        self._patience = patience_of(settings.frozen_after, primitive, sensors)
        # A sample may belong to a tick half a tick before it was taken.
        behind = math.floor(settings.window / dt + 0.5 + TOLERANCE) + 1
        self._modalities = [layout.names.index(name) for name in sensors]
        self._columns = [layout.slice(name) for name in sensors]
        self._ranges = training_ranges(primitive, settings.margin)
        self._reach = behind, math.ceil(settings.longest_gap / dt)
        self._slots = behind + 2
        # One more than are in turn: the state before anything was seen.
        # Whatever it believes, what it says stays near what was demonstrated.
        filter = sharing(filter)
        filter.bounds = Bounds.of(primitive) if filter.bounds is None else filter.bounds
        self._engine = make_engine(filter, layout.mask(sensors), layout.controlled, self._slots + 1, settings.seed)
        self._engine.save(self._slots)
        self._like = next(filter.parameters())
        longest = float(primitive.durations.max())
        self._periodic = primitive.periodic
        self._clock = Clock(dt, longest, len(sensors))
        self._lost = Lost(settings.longest_gap) if isinstance(settings.start, str) else None
        self._opening = Opening(settings.window) if isinstance(settings.start, str) else None
        self.ticks = 0
        self._head: int
        self._dirty: int
        self._freshness: list[Freshness]
        self._now = self._newest = -math.inf
        self._begin(0.0 if isinstance(settings.start, str) else settings.start)

    @property
    def waiting(self) -> bool:
        """Whether the first sample is still to come."""
        return self._opening is not None and self._opening.start is None

    @property
    def now(self) -> float:
        """The present, s; 0 before anybody said when it is."""
        return self._now if math.isfinite(self._now) else 0.0 if self.waiting else self._start

    @property
    def failed(self) -> int:
        """How many ticks the filter could not take in."""
        return self._current().failed

    def plain(self, number: int, values: object) -> Array | None:
        """The numbers of what a sensor sent, in memory of their own; None if it is not what it has."""
        columns = self._columns[number]
        return as_vector(values, columns.stop - columns.start)

    def push(self, number: int, vector: Array | None, moment: float) -> None:
        """Take a sample of a sensor, `plain` numbers, taken at a time in s, NaN if it is none."""
        if vector is not None:
            self._clock.see(number, moment)
        opening = self._opening
        if opening is None:
            usable = self._lost is not None and self._intake.says_something(number, vector, moment)
            before = self._intake.reports[number].early
            self._take(number, vector, moment)
            if usable:
                self._find(number, vector, moment, self._intake.reports[number].early == before)
            return
        usable, waiting = self._intake.says_something(number, vector, moment), self.waiting
        if opening.add(number, vector, moment, usable) and opening.start is not None:
            if waiting:  # what was asked before does not bind the clock of the samples
                self._now = -math.inf
            self._begin(opening.start)
            for earlier in opening.pushes:
                self._take(*earlier)
        else:
            self._take(number, vector, moment)
        if usable and opening.over(moment):
            self._opening = None
        if usable and not waiting:
            early = abs(moment - self._start) > self.settings.longest_gap
            self._find(number, vector, moment, not early)

    def _find(self, number: int, vector: Array | None, moment: float, accepted: bool) -> None:
        """Begin again where samples agree, if none of them is near the first."""
        again = None if self._lost is None else self._lost.add(number, vector, moment, accepted)
        if again is not None:
            self._opening = Opening(self.settings.window)
            self._now = self._newest = -math.inf
            for sample in again:
                self.push(*sample)

    def advance(self, now: float | None) -> None:
        """Filter up to the present, s; default: the newest time of any sample.

        Raises:
            ValueError: it is not finite, or further ahead than the longest gap; times that cannot be seconds.
        """
        if now is not None and not math.isfinite(now):
            raise ValueError(f"now must be a finite time in seconds, got {now}")
        unit = self._clock.guess(now)
        if unit is not None:
            raise ValueError(f"times seem to be in {unit}; push and ask in seconds")
        if self.waiting:
            self._now = self._now if now is None else max(self._now, now)
            return
        if now is not None:
            gap = now - self._time(max(self._head, 0))
            if gap > self.settings.longest_gap:
                raise ValueError(
                    f"now = {now} s is {gap:.1f} s after what was filtered last, more than the longest gap of "
                    f"{self.settings.longest_gap} s; begin a new session"
                )
        self._now = max(self._now, self._start, self._newest if now is None else now)
        newest = math.floor((self._now - self.settings.settle - self._start) / self.dt + TOLERANCE)
        if self._dirty <= self._head:
            self._head = self._dirty - 1
            self._engine.load(self._head % self._slots)
        while self._head < newest:
            self._step()
        self._dirty = self._head + 1

    def phase_now(self) -> tuple[float, float]:
        """Phase and its velocity, 1/s, at the present: since the last tick the interaction went on."""
        phase, velocity = self._engine.clock()
        waits, since = self._engine.waits(), self._since()
        gone = since if waits is None else float(waits.gone(self._like.new_tensor([since])))
        return phase + velocity * gone, velocity

    def place(self) -> float:
        """The phase within 0 and 1."""
        phase, _ = self.phase_now()
        return phase % 1.0 if self._periodic else min(max(phase, 0.0), 1.0)

    def time_to_end(self) -> float:
        """Seconds until phase 1, of who stands still until they go on, too; infinite where there is no end."""
        _, velocity = self.phase_now()
        if self._periodic or velocity <= 0:
            return math.inf
        waits = self._engine.waits()
        rest = 0.0 if waits is None else float(waits.rest)
        return (1 - self.place()) / velocity + rest

    def forecast(self, horizons: Sequence[float]) -> Forecast:
        """Of the controlled DoFs so many seconds ahead of the present; infinity: the end.

        Of a person who may stand still, and on a circle, seconds are asked for: how far they will get is not one
        phase.
        """
        waits = self._engine.waits()
        if (waits is not None or self._periodic) and min(horizons) >= 0:
            return self._engine.forecast_ahead(self._like.new_tensor(horizons) + self._since())
        phase, velocity = self.phase_now()
        gone = horizons if waits is None else waits.gone(self._like.new_tensor(horizons)).tolist()
        ahead = [1.0 if math.isinf(seconds) else phase + velocity * seconds for seconds in gone]
        return self._engine.forecast(
            self._like.new_tensor(ahead if self._periodic else [min(max(at, 0.0), 1.0) for at in ahead])
        )

    def _since(self) -> float:
        """How long ago the last tick was, s."""
        return 0.0 if self.waiting else max(self._now - self._time(max(self._head, 0)), 0.0)

    def labels(self) -> dict[str, float]:
        """Probability of each label."""
        return self._engine.labels()

    def familiarity(self) -> float:
        """How usual the largest surprise so far is; NaN where that was not calibrated."""
        return self._engine.familiarity()

    def states(self) -> list[str]:
        """Of each sensor, see `SessionForecast`."""
        counts = self._engine.counts()
        states = [STATES[0] if counts is None else state_of(counts[number]) for number in self._modalities]
        refused = zip(self._intake.impossible, self._current().still.tolist(), strict=True)
        return [STATES[2] if any(why) else state for why, state in zip(refused, states, strict=True)]

    def stale(self) -> list[int]:
        """Numbers of the sensors of which nothing was used for a while, or ever."""
        oldest = self._now - self.settings.stale_after
        used = self._current().used.tolist()
        return [i for i, tick in enumerate(used) if tick < 0 or self._time(tick) < oldest]

    def report(self) -> list[SensorReport]:
        """A copy of the counts of each sensor."""
        reports = self._intake.report(self._current())
        return [replace(report, state=state) for report, state in zip(reports, self.states(), strict=True)]

    def _begin(self, start: float) -> None:
        """Start at this time, s, with nothing seen."""
        self._start = start
        self._intake = Intake(self._columns, self._ranges, start, self.dt, *self._reach)
        self._freshness = [self._intake.fresh() for _ in range(self._slots)]
        self._head, self._dirty = -1, 0
        self._engine.load(self._slots)
        self._engine.save(-1 % self._slots)

    def _take(self, number: int, vector: Array | None, moment: float) -> None:
        """Store a sample in its tick."""
        if self.waiting and math.isfinite(moment):  # it says nothing: only what is wrong with it is counted
            self._intake.start = moment
        tick = self._intake.put(number, vector, moment, self._head)
        self._newest = max(self._newest, self._intake.reports[number].last)
        if tick is not None:
            self._dirty = min(self._dirty, tick)

    def _current(self) -> Freshness:
        return self._freshness[self._head % self._slots]

    def _time(self, tick: int) -> float:
        return self._start + tick * self.dt

    def _step(self) -> None:
        """One more tick."""
        freshness = self._current().copy()
        self._head += 1
        self.ticks += 1
        if self._head > 0:
            self._engine.predict()
        values, usable = self._intake.usable(self._head, freshness, self._patience)
        if usable.any():
            y = torch.as_tensor(values, dtype=self._like.dtype, device=self._like.device)
            try:
                self._engine.update(y, tuple(usable.tolist()))
                done = self._engine.finite()
            except ValueError:
                done = False
            if not done:
                # Back to before the tick: this one is left out, as if nothing had been measured.
                freshness.failed += 1
                self._engine.load((self._head - 1) % self._slots)
                if self._head > 0:
                    self._engine.predict()
        self._freshness[self._head % self._slots] = freshness
        self._engine.save(self._head % self._slots)
