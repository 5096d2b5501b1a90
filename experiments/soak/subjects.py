"""What is left running: live filters, filters step by step, and sessions begun again with every interaction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from experiments.soak.stream import Sample
from torch_ebip import (
    BSplineBasis,
    EnsembleFilter,
    Filter,
    InteractionPrimitive,
    InteractionSession,
    LiveFilter,
    bip,
    ebip,
    particle_filter,
)
from torch_ebip.learning.starts import Start, tunable

START = Start(factor=100.0, sharpness=10.0)
"""About where tuning starts on the simulated task: R times 100."""


class Health(NamedTuple):
    """How a filter is.

    Attributes:
        finite: whether all of its state and its forecast of the end are.
        phase: mean.
        spread: the smallest standard deviation of a weight that varied at the start, as a share of it then.
        largest: the largest such share.
    """

    finite: bool
    phase: float
    spread: float
    largest: float


class Subject(Protocol):
    """Something that takes samples."""

    def begin(self) -> None:
        """A new interaction; not timed."""

    def step(self, sample: Sample) -> None:
        """Take a sample in; timed."""

    def health(self) -> Health:
        """Looked at now and then; not timed."""


class _Watched:
    """How a state compares with the one that a filter starts from."""

    def __init__(self, filter: Filter) -> None:
        self.filter = filter
        self.start = _deviations(filter.initial_state(generator=torch.Generator().manual_seed(0)))

    @torch.no_grad()
    def look(self, state: Any) -> Health:
        """At a state of the filter."""
        end = self.filter.forecast(state, torch.ones(1))
        phase, varied = self.filter.phase(state), self.start > 0
        share = _deviations(state)[varied] / self.start[varied]
        finite = all(bool(part.isfinite().all()) for part in (state.mean, end.mean, end.variance, phase, share))
        return Health(finite, float(phase), float(share.min()), float(share.max()))


class Live:
    """A live filter: one for all time, or a new one for each interaction."""

    def __init__(self, filter: EnsembleFilter, sensors: Tensor, seed: int, anew: bool = False) -> None:
        self._filter, self._sensors, self._anew = filter, sensors, anew
        self._generator = torch.Generator().manual_seed(seed)
        self._watched = _Watched(filter)
        self._live = LiveFilter(filter, sensors, generator=self._generator)

    def begin(self) -> None:
        """See `Subject`."""
        if self._anew:
            self._live = LiveFilter(self._filter, self._sensors, generator=self._generator)

    def step(self, sample: Sample) -> None:
        """See `Subject`."""
        self._live.predict(sample.dt)
        self._live.update(sample.y, sample.observed)

    def health(self) -> Health:
        """See `Subject`."""
        return self._watched.look(self._live.state)


class Steps:
    """Any filter, by its own steps from state to state; one state for all time."""

    def __init__(self, filter: Filter, used: Tensor, seed: int) -> None:
        self._filter, self._used = filter.restrict(used), used
        self._generator = torch.Generator().manual_seed(seed)
        self._watched = _Watched(self._filter)
        self._state = self._filter.initial_state(generator=self._generator)

    def begin(self) -> None:
        """See `Subject`."""

    @torch.no_grad()
    def step(self, sample: Sample) -> None:
        """See `Subject`."""
        state = self._filter.predict(self._state, sample.dt, self._generator)
        y, observed = sample.y[self._used], sample.observed[self._used]
        self._state, _ = self._filter.update(state, y, observed, self._generator)

    def health(self) -> Health:
        """See `Subject`."""
        return self._watched.look(self._state)


class Sessions:
    """An `InteractionSession` for each interaction: samples are pushed as they come, and the end is asked for."""

    def __init__(self, filter: EnsembleFilter, primitive: InteractionPrimitive, sensors: Tensor) -> None:
        layout = primitive.layout
        self._parts = {name: layout.slice(name) for name in layout.names if bool(sensors[layout.slice(name)].any())}
        self._make: Callable[[], InteractionSession] = lambda: InteractionSession(
            filter, primitive, list(self._parts)
        )

    def begin(self) -> None:
        """See `Subject`."""
        self._session, self._now = self._make(), 0.0
        self._start = self._last = None

    def step(self, sample: Sample) -> None:
        """See `Subject`."""
        self._now += sample.dt
        for name, part in self._parts.items():
            if bool(sample.observed[part].any()):
                self._session.push(name, sample.y[part], self._now)
        self._last = self._session.forecast(now=self._now)
        if self._start is None:
            self._start = self._last.deviation
        if self._session.failed_updates:
            raise ValueError(f"a session left out {self._session.failed_updates} ticks")

    def health(self) -> Health:
        """See `Subject`; spread is that of the forecast, as a share of the interaction's first."""
        assert self._last is not None
        assert self._start is not None
        share = self._last.deviation / self._start
        finite = bool(self._last.mean.isfinite().all()) and bool(share.isfinite().all())
        return Health(finite, self._last.phase, float(share.min()), float(share.max()))


def _deviations(state: Any) -> Tensor:
    """Standard deviations of the weights in a state [n_weights]."""
    if hasattr(state, "members"):
        anomalies = state.members[..., 2:] - state.mean[..., 2:].unsqueeze(-2)
        return anomalies.square().mean(-2).sqrt()
    variance: Tensor = state.covariance.diagonal(dim1=-2, dim2=-1)[..., 2:]
    return variance.sqrt()  # NaN where it is negative


def _square_root(primitive: InteractionPrimitive) -> EnsembleFilter:
    """What is tuned, but without inflation."""
    return ebip(
        primitive,
        residual_variance=START.factor * primitive.residual_variance,
        context=BSplineBasis(4),
        square_root=True,
        weigh=True,
        sharpness=START.sharpness,
    )


SUBJECTS: dict[str, Callable[[InteractionPrimitive, Tensor, int], Subject]] = {
    "closed_form": lambda primitive, sensors, seed: Live(ebip(primitive), sensors, seed),
    "square_root": lambda primitive, sensors, seed: Live(_square_root(primitive), sensors, seed),
    "tuned": lambda primitive, sensors, seed: Live(tunable(primitive, START), sensors, seed, anew=True),
    "tuned_endless": lambda primitive, sensors, seed: Live(tunable(primitive, START), sensors, seed),
    "sessions": lambda primitive, sensors, seed: Sessions(tunable(primitive, START), primitive, sensors),
    "particle": lambda primitive, sensors, seed: Steps(particle_filter(primitive, weight_noise=0.05), sensors, seed),
    "bip": lambda primitive, sensors, seed: Steps(bip(primitive), sensors, seed),
}
"""By name. `closed_form` is the paper's, `square_root` is weighted and has R over phase, `tuned` also inflates and,
as it is used, is begun anew with each interaction; so is a session. To the others all interactions are one without
end. That `tuned_endless` does not stand: members of little weight leave the others more and more, until S cannot be
factored."""
DEFAULT = ("closed_form", "tuned", "sessions", "particle", "bip")
SHARES = {"particle": 0.2, "bip": 0.1, "sessions": 0.1}
"""Of the steps that are asked for, where they are slow and have no state or a small one that could drift."""
