"""A filter at work on one interaction that can be wound back: by the live path where there is one."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from torch_ebip.common.draws import seeded, set_states, states_of
from torch_ebip.filtering.sequence import surprise_of
from torch_ebip.interaction.filter_kinds import InteractionEnsembleFilter
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.pace.waiting import Waits
from torch_ebip.live.filter import LiveFilter, LiveSnapshot


class Engine(Protocol):
    """What a session needs of a filter. D is the number of DoFs of the layout."""

    def predict(self) -> None:
        """Propagate by the time between samples of the demonstrations."""

    def update(self, y: Tensor, measured: tuple[bool, ...]) -> None:
        """Take in y [D] where it is measured; a ValueError says that it cannot be and may leave half of it."""

    def save(self, slot: int) -> None:
        """Keep everything in a slot."""

    def load(self, slot: int) -> None:
        """Go back to what a slot holds: to the bit, draws included."""

    def clock(self) -> tuple[float, float]:
        """Mean phase and mean phase velocity, 1/s."""

    def waits(self) -> Waits | None:
        """Whether the person stands still; None where nobody looks."""

    def finite(self) -> bool:
        """Whether the state is, and small enough for its variance to be."""

    def forecast(self, phase: Tensor) -> Forecast:
        """Of the controlled DoFs at phases [P]."""

    def forecast_ahead(self, seconds: Tensor) -> Forecast:
        """Of the controlled DoFs so many seconds ahead, [P]; infinity is the end."""

    def labels(self) -> dict[str, float]:
        """Probability of each label; empty where the filter cannot say."""

    def familiarity(self) -> float:
        """How usual the largest surprise so far is, 0 to 1; NaN where that was not calibrated."""

    def counts(self) -> list[float] | None:
        """What each modality of the layout counts, 0 to 1; None where nobody judges."""


def make_engine(filter: InteractionFilter, sensors: Tensor, controlled: Tensor, slots: int, seed: int) -> Engine:
    """The faster of the two that serves a filter.

    Args:
        filter: of an interaction primitive, as it is now.
        sensors, controlled: bool [D].
        slots: how many states can be kept.
        seed: of all draws.
    """
    if isinstance(filter, InteractionEnsembleFilter) and filter.has_live_path:
        return _LiveEngine(filter, sensors, controlled, slots, seed)
    return _StateEngine(filter, sensors, controlled, slots, seed)


class _LiveEngine:
    """In place, with buffers for every slot."""

    def __init__(
        self, filter: InteractionEnsembleFilter, sensors: Tensor, controlled: Tensor, slots: int, seed: int
    ) -> None:
        self._live = LiveFilter(filter, sensors, generator=seeded(seed))
        self._controlled = controlled
        self._slots: list[LiveSnapshot] = [self._live.save() for _ in range(slots)]

    def predict(self) -> None:
        """See `Engine`."""
        self._live.predict()

    def update(self, y: Tensor, measured: tuple[bool, ...]) -> None:
        """See `Engine`."""
        self._live.take(y, measured, None)

    def save(self, slot: int) -> None:
        """See `Engine`."""
        self._slots[slot] = self._live.save(self._slots[slot])

    def load(self, slot: int) -> None:
        """See `Engine`."""
        self._live.load(self._slots[slot])

    def clock(self) -> tuple[float, float]:
        """See `Engine`."""
        return float(self._live.phase), float(self._live.phase_velocity)

    def waits(self) -> Waits | None:
        """See `Engine`."""
        return self._live.waits

    def finite(self) -> bool:
        """See `Engine`."""
        return self._live.finite

    def forecast(self, phase: Tensor) -> Forecast:
        """See `Engine`."""
        return self._live.forecast(phase, self._controlled)

    def forecast_ahead(self, seconds: Tensor) -> Forecast:
        """See `Engine`."""
        return self._live.forecast(None, self._controlled, ahead=seconds)

    def labels(self) -> dict[str, float]:
        """See `Engine`."""
        live = self._live
        if live.filter.recognition is None or live.carrier.memory.weighting is None:
            return {}
        return {label: float(probability) for label, probability in live.recognise().items()}

    def familiarity(self) -> float:
        """See `Engine`."""
        return float(self._live.familiarity)

    def counts(self) -> list[float] | None:
        """See `Engine`."""
        counts = self._live.counts
        return None if counts is None else counts.tolist()


def _tensors(state: Any) -> list[Tensor]:
    """All tensors of a state, its members or mean first."""
    if isinstance(state, Tensor):
        return [state]
    return [] if state is None else [tensor for part in state for tensor in _tensors(part)]


class _StateEngine:
    """By the filter's own steps from state to state; a slot holds a state, which nothing changes."""

    def __init__(self, filter: InteractionFilter, sensors: Tensor, controlled: Tensor, slots: int, seed: int) -> None:
        used = sensors | controlled
        # DoFs that are neither measured nor asked for influence nothing.
        self._filter = filter.restrict(used)
        self._used, self._controlled = used.nonzero().squeeze(-1), controlled[used]
        self._generator = seeded(seed)
        with torch.no_grad():
            self._state: Any = self._filter.initial_state(generator=self._generator)
        self._slots: list[tuple[Any, list[Tensor]]] = [(self._state, [])] * slots

    @torch.no_grad()
    def predict(self) -> None:
        """See `Engine`."""
        self._state = self._filter.predict(self._state, self._filter.dt, self._generator)

    @torch.no_grad()
    def update(self, y: Tensor, measured: tuple[bool, ...]) -> None:
        """See `Engine`."""
        observed = torch.tensor(measured)[self._used].to(y.device)
        y = torch.where(observed, y[self._used.to(y.device)], 0)
        self._state, _ = self._filter.update(self._state, y, observed, self._generator)

    def save(self, slot: int) -> None:
        """See `Engine`."""
        self._slots[slot] = self._state, states_of(self._generator)

    def load(self, slot: int) -> None:
        """See `Engine`."""
        self._state, draws = self._slots[slot]
        set_states(self._generator, draws)

    @torch.no_grad()
    def clock(self) -> tuple[float, float]:
        """See `Engine`."""
        return float(self._filter.phase(self._state)), float(self._filter.phase_velocity(self._state))

    @torch.no_grad()
    def waits(self) -> Waits | None:
        """See `Engine`."""
        return self._filter.waits(self._state)

    def finite(self) -> bool:
        """See `Engine`."""
        first, *rest = _tensors(self._state)
        return bool(first.square().sum().isfinite()) and not any(bool(part.isnan().any()) for part in rest)

    @torch.no_grad()
    def forecast(self, phase: Tensor) -> Forecast:
        """See `Engine`."""
        return self._filter.forecast(self._state, phase).select(self._controlled.to(phase.device))

    @torch.no_grad()
    def forecast_ahead(self, seconds: Tensor) -> Forecast:
        """See `Engine`."""
        return self._filter.forecast(self._state, ahead=seconds).select(self._controlled.to(seconds.device))

    @torch.no_grad()
    def labels(self) -> dict[str, float]:
        """See `Engine`."""
        memory = getattr(self._state, "memory", None)
        if self._filter.recognition is None or memory is None or memory.weighting is None:
            return {}
        return {label: float(p) for label, p in self._filter.recognise(self._state).items()}

    @torch.no_grad()
    def familiarity(self) -> float:
        """See `Engine`."""
        return float(self._filter.familiarity(self._state))

    def counts(self) -> list[float] | None:
        """See `Engine`."""
        felt = surprise_of(self._state)
        return None if felt is None else felt.counts.tolist()
