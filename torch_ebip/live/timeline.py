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
from torch_ebip.live.clocks import Clocks
from torch_ebip.live.engine import make_engine
from torch_ebip.live.intake import Array, Intake, Sample, training_ranges
from torch_ebip.live.notes import notes
from torch_ebip.live.opening import Lost, Opening, Units
from torch_ebip.live.place import Place
from torch_ebip.live.report import SessionReport
from torch_ebip.live.settings import SessionSettings, delays_of, patience_of
from torch_ebip.live.track import REPEATS, Track
from torch_ebip.recordings.angles import wrapped

TOLERANCE = 1e-3
"""Ticks by which a time may be short of a tick and still be it: clocks that count from 1970 round to microseconds."""


class Timeline:
    """One filter on ticks as far apart as the demonstrations' samples, fed by M sensors. See `InteractionSession`.

    Args:
        filter: of the primitive.
        primitive: of the demonstrations.
        sensors: names of modalities, M of them.
        settings: how to treat them.
    """

    def __init__(
        self,
        filter: InteractionFilter,
        primitive: InteractionPrimitive,
        sensors: Sequence[str],
        settings: SessionSettings,
    ) -> None:
        layout, dt = primitive.layout, filter.dt
        self.settings, self.dt, self._names = settings, dt, tuple(sensors)
        # A sample may belong to a tick half a tick before it was taken.
        behind = math.floor(settings.window / dt + 0.5 + TOLERANCE) + 1
        self._modalities = [layout.names.index(name) for name in sensors]
        self._columns = [layout.slice(name) for name in sensors]
        self._ranges = training_ranges(primitive, settings.margin)
        self._reach = behind, math.ceil(settings.longest_gap / dt)
        slots = behind + 2
        # Whatever it believes, what it says stays near what was demonstrated.
        filter = sharing(filter)
        filter.bounds = Bounds.of(primitive) if filter.bounds is None else filter.bounds
        # Two states beside those of the ticks: before anything was seen, and where the past is being repeated.
        self._engine = make_engine(filter, layout.mask(sensors), layout.controlled, slots + 2, settings.seed)
        self._like = next(filter.parameters())
        self._track = Track(self._engine, slots, patience_of(settings.frozen_after, primitive, sensors), self._like)
        self._periodic = primitive.periodic
        angles = layout.angles[layout.controlled].to(self._like.device)
        self._angles = angles if bool(angles.any()) else None
        self._units = Units(dt, float(primitive.durations.max()), len(sensors))
        delays = delays_of(settings.delays, sensors)
        self._clocks = Clocks(dt, settings.window, settings.correct_clocks, delays)
        self._before = -math.inf
        self._place: Place | None = None
        self._open(settings.start)

    def restart(self, start: float | str) -> None:
        """Another interaction: nothing was seen of it yet. What was learned of the clocks stays."""
        self._before = max(self._now, self._newest) if isinstance(start, str) else -math.inf
        self._clocks.forget()
        self._open(start)

    def _open(self, start: float | str) -> None:
        """Wait for the first sample, or for a time, s."""
        found = isinstance(start, str)
        self._lost = Lost(self.settings.longest_gap) if found else None
        self._opening = Opening(self.settings.window) if found else None
        self._now = self._newest = -math.inf
        self._first = math.nan
        self._given = not found
        self._turned_back = 0.0
        self._over: float | None = None
        self._begin(0.0 if isinstance(start, str) else start)

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
        return self._track.freshness.failed

    @property
    def ticks(self) -> int:
        """See `Track`."""
        return self._track.ticks

    def push(self, number: int, vector: Array | None, moment: float) -> None:
        """Take a sample of a sensor, numbers in memory of their own, taken at a time in s, NaN if it is none."""
        if vector is not None:
            self._units.see(number, moment)
        for sample in self._clocks.admit(self._intake.look(number, vector, moment)):
            self._put(sample)
        for sample in self._clocks.refused():
            self._intake.refuse(sample)

    def _put(self, sample: Sample) -> None:
        """Store a sample of a clock that can be believed, and find out with it when the interaction began."""
        opening = self._opening
        if opening is None:
            before = self._intake.reports[sample.number].early
            self._take(sample)
            if self._lost is not None and sample.says:
                self._find(sample, self._intake.reports[sample.number].early == before)
            return
        waiting, usable = self.waiting, sample.says
        if usable and sample.time <= self._before:  # of the interaction before this one
            self._intake.refuse(sample)
            return
        if opening.add(sample) and opening.start is not None:
            if waiting:  # what was asked before does not bind the clock of the samples
                self._now = -math.inf
            self._begin(opening.start)
            for earlier in opening.pushes:
                self._take(earlier)
        else:
            self._take(sample)
        if usable and opening.over(sample.time):
            self._opening = None
        if usable and not waiting:
            early = abs(sample.time - self._start) > self.settings.longest_gap
            self._find(sample, not early)

    def _find(self, sample: Sample, accepted: bool) -> None:
        """Begin again where samples agree, if none of them is near the first."""
        again = None if self._lost is None else self._lost.add(sample, accepted)
        if again is not None:
            self._opening = Opening(self.settings.window)
            self._now = self._newest = -math.inf
            self._clocks.forget(offsets=True)
            for known in again:
                self._clocks.believe(known)
                self._put(known)

    def advance(self, now: float | None) -> None:
        """Filter up to the present, s; default: the newest time of any sample.

        Raises:
            ValueError: it is not finite, or further ahead than the longest gap; times that cannot be seconds.
        """
        if now is not None and not math.isfinite(now):
            raise ValueError(f"now must be a finite time in seconds, got {now}")
        unit = self._units.guess(now)
        if unit is not None:
            raise ValueError(f"times seem to be in {unit}; push and ask in seconds")
        if self.waiting:
            self._now = self._now if now is None else max(self._now, now)
            return
        if now is not None:
            gap = now - self._time(max(self._track.head, 0))
            if gap > self.settings.longest_gap:
                raise ValueError(
                    f"now = {now} s is {gap:.1f} s after what was filtered last, more than the longest gap of "
                    f"{self.settings.longest_gap} s; begin a new session, or `restart` this one"
                )
            self._turned_back = max(self._now - now, 0.0)
            for sample in self._clocks.tell(now):
                self._put(sample)
        before = self._now
        self._now = max(self._now, self._start, self._newest if now is None else now)
        newest = math.floor((self._now - self.settings.settle - self._start) / self.dt + TOLERANCE)
        self._track.advance(newest, whole=self._now == before)
        self._place = None
        if self.finished and self._over is None:
            self._over = self._now

    @property
    def place(self) -> Place:
        """Where the interaction is at the present: since the last tick it went on."""
        if self._place is None:
            self._place = Place.of(self._engine, self._since(), self._periodic)
        return self._place

    @property
    def finished(self) -> bool:
        """Whether the interaction is over."""
        return not self.waiting and self.place.finished(self.dt)

    def forecast(self, horizons: Sequence[float]) -> Forecast:
        """Of the controlled DoFs so many seconds ahead of the present; infinity: the end.

        Angles are in (-pi, pi]. Of a person who may stand still, and on a circle, seconds are asked for: how far they
        will get is not one phase.
        """
        if (self.place.waits is not None or self._periodic) and min(horizons) >= 0:
            said = self._engine.forecast_ahead(self._like.new_tensor(horizons) + self._since())
        else:
            said = self._engine.forecast(self._like.new_tensor(self.place.ahead(horizons)))
        if self._angles is None:
            return said
        return said._replace(mean=torch.where(self._angles, wrapped(said.mean), said.mean))

    def _since(self) -> float:
        """How long ago the last tick was, s."""
        return 0.0 if self.waiting else max(self._now - self._time(max(self._track.head, 0)), 0.0)

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
        refused = zip(self._intake.impossible, self._track.freshness.still.tolist(), strict=True)
        return [STATES[2] if any(why) else state for why, state in zip(refused, states, strict=True)]

    def stale(self) -> list[int]:
        """Numbers of the sensors of which nothing was used for a while, or ever."""
        oldest = self._now - self.settings.stale_after
        used = self._track.freshness.used.tolist()
        return [i for i, tick in enumerate(used) if tick < 0 or self._time(tick) < oldest]

    def report(self) -> SessionReport:
        """A copy of the counts of each sensor, and what is wrong with time."""
        of = zip(self._intake.report(self._track.freshness), self.states(), self._clocks.sensors, strict=True)
        full = [clock.reported(replace(report, state=state)) for report, state, clock in of]
        return SessionReport(dict(zip(self._names, full, strict=True)), self.notes())

    def notes(self) -> tuple[str, ...]:
        """See `SessionReport`."""
        began = self._first - self._start if self._given else 0.0
        reports, said = self._intake.reports, (began, self._turned_back, self._over)
        return notes(self._names, self._clocks, reports, self.settings, self.dt, *said)

    def _begin(self, start: float) -> None:
        """Start at this time, s, with nothing seen."""
        self._start = start
        self._intake = Intake(self._columns, self._ranges, start, self.dt, *self._reach)
        self._track.begin(self._intake)
        self._place = None

    def _take(self, sample: Sample) -> None:
        """Store a sample in its tick."""
        if self.waiting and math.isfinite(sample.time):  # it says nothing: only what is wrong with it is counted
            self._intake.start = sample.time
        tick = self._intake.put(sample, self._track.head)
        self._newest = max(self._newest, self._intake.reports[sample.number].last)
        if tick is not None:
            if self._given and not self._first <= sample.time:
                self._first = sample.time
            late = self._clocks.sensors[sample.number].lateness - self.settings.settle
            self._track.changed(tick, late > REPEATS * self.dt)

    def _time(self, tick: int) -> float:
        return self._start + tick * self.dt
