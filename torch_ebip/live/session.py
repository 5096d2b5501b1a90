"""One live interaction: sensors push what they have when they have it, the robot asks what is to come.

Time is cut into ticks as far apart as the demonstrations' samples. A filter takes in one tick after the other, each
with the sample of every sensor that was taken nearest to it. A sample that arrives late belongs to a tick that is
past: the filter is wound back to the tick before and takes in again what followed (fixed-lag replay), with the draws
it had. So the state depends on what was measured and when, never on the order in which it arrived nor on when
somebody asked. (What always arrives late is repeated a few ticks at a time: see `torch_ebip.live.track`.)

Sensors leave their samples in a queue. They are looked at, recorded and filtered by whoever asks.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Sequence
from dataclasses import asdict, replace
from types import TracebackType
from typing import Any, NoReturn

import numpy as np

from torch_ebip.common.ambient import in_own_modes
from torch_ebip.common.forks import forks
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.live.arrivals import HELP, Arrival, Arrivals, kept
from torch_ebip.live.forecast import SessionForecast, as_present, sampled
from torch_ebip.live.intake import as_number, as_vector
from torch_ebip.live.log import SessionLog, fingerprint
from torch_ebip.live.opening import FIRST_SAMPLE
from torch_ebip.live.report import SessionReport
from torch_ebip.live.settings import SessionSettings
from torch_ebip.live.timeline import Timeline


class InteractionSession:
    """Filters one interaction as it happens. Bad sensor values never raise: they are refused and counted.

    Its methods may be called from several threads. `push` waits for nobody; the others wait for each other. It lives
    in the process that made it, and is not copied.

    Args:
        filter: of the primitive, tuned or not: any kind. Not changed, and not to be changed while the session lasts.
        primitive: whose layout names sensors and controlled DoFs, and whose demonstrations say what is plausible.
        sensors: names of the modalities that will be pushed; default: all that are not controlled.
        settings: how to treat them; default: `SessionSettings()`.
        record: file to write everything to that is pushed and asked, for `replay`; must not exist.

    Raises:
        ValueError: a sensor that the layout does not have, that is controlled or named twice; no controlled DoF; a
            filter of other DoFs, in another order, or at another rate.
        FileExistsError, OSError: the recording cannot be written.
    """

    @in_own_modes
    def __init__(
        self,
        filter: InteractionFilter,
        primitive: InteractionPrimitive,
        sensors: Sequence[str] | None = None,
        settings: SessionSettings | None = None,
        record: str | os.PathLike[str] | None = None,
    ) -> None:
        layout = primitive.layout
        if filter.n_dofs != layout.n_dofs:
            raise ValueError(f"the filter has {filter.n_dofs} DoFs, the primitive's layout {layout.n_dofs}")
        if filter.dof_names is not None and filter.dof_names != layout.dofs:
            pairs = zip(filter.dof_names, layout.dofs, strict=True)
            first = next((ours, theirs) for ours, theirs in pairs if ours != theirs)
            raise ValueError(f"the filter and the primitive have other columns: {first[0]!r} and {first[1]!r}")
        if abs(filter.dt * primitive.rate - 1) > 1e-6:
            raise ValueError(f"the filter takes {1 / filter.dt:g} samples a second, the primitive {primitive.rate:g}")
        if not bool(layout.controlled.any()):
            raise ValueError(f"nothing to forecast: no modality of {', '.join(layout.names)} is controlled")
        if sensors is None:
            sensors = [modality.name for modality in layout.modalities if not modality.controlled]
        if isinstance(sensors, str) or len(set(sensors)) != len(sensors):
            raise ValueError(f"sensors must be different names of modalities, got {sensors!r}")
        for name in sensors:
            if layout[name].controlled:
                raise ValueError(f"{name!r} is controlled by the robot, not a sensor")
        if not sensors:
            raise ValueError("a session needs at least one sensor")
        self._filter = filter
        self.settings = settings = SessionSettings() if settings is None else settings
        self.sensors, self.dt = tuple(sensors), filter.dt
        self.dofs = tuple(dof for dof, ours in zip(layout.dofs, layout.controlled.tolist(), strict=True) if ours)
        self._lengths = [len(layout[name].dofs) for name in self.sensors]
        self._numbers = {name: i for i, name in enumerate(self.sensors)}
        self._timeline = Timeline(filter, primitive, self.sensors, settings)
        self._longest = float(primitive.durations.max())
        self._arrivals = Arrivals()
        self._lock = threading.RLock()
        self._process, self._forks, self._closed = os.getpid(), forks(), False
        self._log: SessionLog | None = None
        if record is not None:
            header = {
                "filter": fingerprint(filter),
                "primitive": fingerprint(primitive),
                "sensors": list(self.sensors),
                "settings": asdict(settings),
            }
            self._log = SessionLog(record, header)

    def push(self, sensor: str, values: Any, time: Any) -> None:
        """Take a sample of a sensor; it waits in a queue until somebody asks, and `push` for nobody.

        Args:
            sensor: name of a modality.
            values: one number for each of its DoFs, in their units; NaN = not measured.
            time: when it was taken, s.

        Raises:
            ValueError: no such sensor.
            RuntimeError: the session was closed, or made in another process. Nothing else: see `report`.
        """
        number = self._numbers.get(sensor)
        if number is None:
            raise ValueError(f"no sensor {sensor!r}; this session has {', '.join(self.sensors)}")
        if self._closed or self._forks != forks():
            self._check()
        moment = time if type(time) is float else as_number(time)
        self._arrivals.put(Arrival(number, kept(values, self._lengths[number]), moment))
        if self._arrivals.many and self._lock.acquire(blocking=False):
            try:
                self._take_in(HELP)
            finally:
                self._lock.release()

    @in_own_modes
    def _take_in(self, most: int | None = None) -> None:
        """What is in the queue, at most so many samples; with the lock held."""
        for number, sent, time in self._arrivals.take(most):
            values = as_vector(sent, self._lengths[number])
            if self._log is not None:
                self._log.write(["push", self.sensors[number], time, None if values is None else values.tolist()])
            self._timeline.push(number, values, time)

    def _check(self) -> None:
        """Refuse a session that was closed, or that a fork has copied."""
        if self._closed:
            raise RuntimeError("this session was closed; make a new one")
        if self._forks != forks():
            raise RuntimeError(
                f"this session belongs to process {self._process}, whose threads and recording a fork does not copy; "
                "make a new one here"
            )

    @in_own_modes
    def advance(self, now: float | None = None) -> None:
        """Filter up to the present.

        Args:
            now: the present, s; default: the newest time of any sample. It never runs backwards.

        Raises:
            ValueError: it is not finite, or further ahead than ``longest_gap``.
            RuntimeError: the session was closed, or made in another process.
        """
        self._check()
        now = as_present(now)
        with self._lock:
            self._take_in()
            self._timeline.advance(now)
            if self._log is not None:
                self._log.write(["advance", now])

    @in_own_modes
    def forecast(
        self,
        horizon: float | Sequence[float] | None = None,
        now: float | None = None,
        *,
        rate: float | None = None,
    ) -> SessionForecast:
        """Filter up to the present, and say what the controlled DoFs should be.

        Args:
            horizon: seconds from now, one or several; default: the end of the interaction, phase 1. What lies
                behind the end is the end.
            now: see `advance`.
            rate: of the robot's controller, Hz: the way from now on, so many times a second, up to the horizon (one
                number; default: the end, or the longest demonstration's duration if that is sooner).

        Raises:
            ValueError: see `advance`; a horizon that is not finite; several of them with a rate; a rate that is not
                positive, or asks for more than `MOST_POINTS`.
            RuntimeError: the session was closed, or made in another process.
        """
        self._check()
        now = as_present(now)
        several = horizon is not None and np.ndim(horizon) > 0
        horizons = [] if horizon is None else np.atleast_1d(np.asarray(horizon, dtype=np.float64)).tolist()
        if not all(math.isfinite(h) for h in horizons):
            raise ValueError(f"horizons must be finite numbers of seconds, got {horizons}")
        if rate is not None and several:
            raise ValueError("a rate goes with one horizon, up to which the way is sampled, not with several")
        with self._lock:
            self._take_in()
            self._timeline.advance(now)
            timeline = self._timeline
            left = timeline.place.time_to_end
            if rate is not None:
                end = min(left, self._longest)
                horizons, several, horizon = sampled(horizons[0] if horizons else end, rate), True, 0.0
            expected = timeline.forecast(horizons if horizon is not None else [math.inf])
            mean, deviation = expected.mean, expected.variance.sqrt()
            if self._log is not None:
                asked = horizons if several else horizons[0] if horizons else None
                self._log.write(["forecast", now, asked, mean.tolist()])
            if not several:
                mean, deviation = mean[0], deviation[0]
            phase = timeline.place.within
            now, stale = timeline.now, tuple(self.sensors[i] for i in timeline.stale())
            return SessionForecast(
                now, phase, left, self.dofs, mean, deviation, stale, tuple(horizons),
                timeline.labels(), timeline.familiarity(), dict(zip(self.sensors, timeline.states(), strict=True)),
                timeline.finished, timeline.notes(),
            )  # fmt: skip

    @in_own_modes
    def restart(self, start: float | str | None = None) -> None:
        """Another interaction, with the same filter, sensors, settings and draws: as a new session, at no cost.

        What is in the queue belongs to the interaction before, and so does what was taken before the present. Reports
        begin anew; what was learned of the clocks stays. A recording goes on.

        Args:
            start: see `SessionSettings`; default: the first sample.

        Raises:
            ValueError: a start that is no finite time, nor the first sample.
            RuntimeError: the session was closed, or made in another process.
        """
        self._check()
        start = replace(self.settings, start=FIRST_SAMPLE if start is None else start).start
        with self._lock:
            self._take_in()
            self._timeline.restart(start)
            if self._log is not None:
                self._log.write(["restart", start])

    @property
    def failed_updates(self) -> int:
        """How many ticks were left out because the filter could not take them in."""
        with self._lock:
            return self._timeline.failed

    @property
    def ticks_filtered(self) -> int:
        """How many ticks the filter was led through so far, those that late samples made it repeat included."""
        with self._lock:
            return self._timeline.ticks

    def report(self) -> SessionReport:
        """What became of everything that was pushed since the interaction began, by sensor; and notes about time."""
        with self._lock:
            self._take_in()
            return self._timeline.report()

    def close(self) -> None:
        """Take in what waits, and end the recording, if there is one. Only `report` answers after that."""
        if self._forks != forks():  # of the parent; who holds the lock there is not here
            return
        with self._lock:
            self._closed = True
            self._take_in()
            if self._log is not None:
                self._log.close()

    def __reduce__(self) -> NoReturn:
        """Neither copied nor pickled."""
        raise TypeError(
            "a session is one interaction at work and is not copied; make a new one, or record this one and replay it"
        )

    def __copy__(self) -> NoReturn:
        """See `__reduce__`."""
        self.__reduce__()

    def __deepcopy__(self, memo: object) -> NoReturn:
        """See `__reduce__`."""
        self.__reduce__()

    def __repr__(self) -> str:
        return (
            f"InteractionSession({type(self._filter).__name__}, {', '.join(self.sensors)} -> {', '.join(self.dofs)}, "
            f"{'not begun' if self._timeline.waiting else f'at {self._timeline.now:g} s'})"
        )

    def __enter__(self) -> InteractionSession:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
