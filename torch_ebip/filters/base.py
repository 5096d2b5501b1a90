"""The contract of every filter: predict, update, a whole sequence, a forecast."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

State = Any
"""A NamedTuple of tensors with leading batch dimensions; every filter has its own."""


class Trace(NamedTuple):
    """What filtering a sequence leaves.

    Attributes:
        state: after the last sample.
        phase: [..., T], mean phase after each sample; NaN where the observation has no phase.
        log_likelihood: [..., T], of each sample given those before it.
        projection: [..., T, D], mean of h(x) after each sample; [..., T, 0] if it was not asked for.
        kept: the states asked for with ``keep``, batch dimensions [..., K]; None if none were.
    """

    state: State
    phase: Tensor
    log_likelihood: Tensor
    projection: Tensor
    kept: State | None


class Forecast(NamedTuple):
    """What the filter expects at some phases.

    Attributes:
        mean: [..., P, D], units of the DoFs.
        variance: [..., P, D], of the filter's belief about the noise-free trajectory; squared units.
        phase: [..., P].
    """

    mean: Tensor
    variance: Tensor
    phase: Tensor


class Filter(nn.Module, ABC):
    """A Bayesian filter over interactions, differentiable in its noise parameters.

    Args:
        dt: seconds between samples where none is given.
        n_dofs: D.
    """

    dt: float
    n_dofs: int

    def __init__(self, dt: float, n_dofs: int) -> None:
        super().__init__()
        if not dt > 0:
            raise ValueError(f"dt must be a positive number of seconds, got {dt}")
        self.dt = dt
        self.n_dofs = n_dofs

    @abstractmethod
    def initial_state(
        self,
        batch_shape: tuple[int, ...] = (),
        members: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> State:
        """The state before any observation, at phase 0.

        Args:
            batch_shape: leading dimensions.
            members: int64 [..., E], which demonstrations form the ensemble; default: see the prior.
            generator: of the draws.
        """

    @abstractmethod
    def _predict(self, state: State, dt: Tensor, generator: torch.Generator | None) -> State:
        """`predict` with dt as a tensor."""

    @abstractmethod
    def _update(
        self, state: State, y: Tensor, observed: Tensor, generator: torch.Generator | None
    ) -> tuple[State, Tensor]:
        """`update` with arguments that were checked."""

    @abstractmethod
    def project(self, state: State) -> Tensor:
        """[..., D], mean of h(x), units of the DoFs."""

    @abstractmethod
    def phase(self, state: State) -> Tensor:
        """[...], mean phase; NaN where the observation has no phase."""

    @abstractmethod
    def forecast(self, state: State, phase: Tensor | None = None) -> Forecast:
        """The trajectory that the state implies.

        Args:
            state: of this filter.
            phase: [P] or [..., P]; default: 50 phases evenly from the current one to 1.
        """

    def predict(self, state: State, dt: float | Tensor, generator: torch.Generator | None = None) -> State:
        """Propagate by dt seconds: a number, or a tensor [...] with one for each entry of the batch."""
        return self._predict(state, torch.as_tensor(dt).to(state[0]), generator)

    def update(
        self,
        state: State,
        y: Tensor,
        observed: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> tuple[State, Tensor]:
        """Take in one sample.

        Args:
            state: of this filter, predicted to the time of the sample.
            y: [..., D] in units of the DoFs.
            observed: bool [..., D]; default: where y is not NaN.
            generator: of the draws.

        Returns:
            The updated state and the log-likelihood [...] of the sample; nothing measured changes nothing and
            has log-likelihood 0.

        Raises:
            ValueError: wrong shapes; NaN or infinity where observed; an innovation covariance that cannot
                be factored.
        """
        return self._update(state, *self._checked(y, observed), generator)

    def forward(
        self,
        y: Tensor,
        observed: Tensor | None = None,
        dt: float | Tensor | None = None,
        state: State | None = None,
        generator: torch.Generator | None = None,
        *,
        keep: Tensor | None = None,
        segment: int | None = None,
        project: bool = True,
    ) -> Trace:
        """Filter a whole sequence.

        The first sample is taken at the time of the state (phase 0 by default), then a prediction by dt goes
        before each further one. To go on with a sequence, `predict` the last state first.

        Args:
            y: [..., T, D] in units of the DoFs; NaN = not measured.
            observed: bool [..., T, D]; default: where y is not NaN.
            dt: seconds between samples, a number or [...]; default: that of the demonstrations.
            state: default: `initial_state` of the batch.
            generator: of all draws.
            keep: int64 [..., K], after which samples (0 = the first) to keep the state of each entry.
            segment: samples a segment of gradient checkpointing; memory for gradients then grows with
                T / segment + segment instead of T, at the price of a second forward pass. Exact: every
                segment is recomputed with the draws it had.
            project: whether to compute `Trace.projection`.

        Raises:
            ValueError: wrong shapes, NaN or infinity where observed, a step to keep that there is not.
        """
        y, observed = self._checked(y, observed)
        if y.ndim < 2 or y.shape[-2] < 1:
            raise ValueError(f"y must be [..., T, {self.n_dofs}] with at least one sample, got {tuple(y.shape)}")
        batch, length = y.shape[:-2], y.shape[-2]
        if state is None:
            state = self.initial_state(batch, generator=generator)
        elif state[0].shape[: len(batch)] != batch:
            raise ValueError(f"the state's batch does not begin with {list(batch)}: {list(state[0].shape)}")
        if keep is not None and (
            keep.shape[:-1] != batch or keep.numel() == 0 or int(keep.min()) < 0 or int(keep.max()) >= length
        ):
            raise ValueError(f"keep must be [{', '.join(map(str, batch))}, K] with steps 0..{length - 1}, got {keep}")
        step = torch.as_tensor(self.dt if dt is None else dt).to(state[0])

        def run(state: State, start: int, stop: int, generator: torch.Generator | None) -> _Segment:
            """Samples start to stop - 1."""
            record = _Segment(state, [], [], [], [])
            for t in range(start, stop):
                if t > 0:
                    state = self._predict(state, step, generator)
                state, likelihood = self._update(state, y[..., t, :], observed[..., t, :], generator)
                record.log_likelihood.append(likelihood.expand(batch))
                record.phase.append(self.phase(state).expand(batch))
                record.projection.append(self.project(state) if project else state[0].new_zeros(*batch, 0))
                if keep is not None:
                    record.kept.extend(_pick(state, keep == t))
            return record._replace(state=state)

        segments = []
        for start in range(0, length, segment or length):
            stop = min(start + (segment or length), length)
            execute = partial(_checkpointed, run) if segment else run
            done = execute(state, start, stop, generator)
            state = done.state
            segments.append(done)
        return Trace(
            state,
            torch.stack([phase for part in segments for phase in part.phase], -1),
            torch.stack([value for part in segments for value in part.log_likelihood], -1),
            torch.stack([value for part in segments for value in part.projection], -2),
            None if keep is None else _assemble([pick for part in segments for pick in part.kept], keep.shape),
        )

    def _checked(self, y: Tensor, observed: Tensor | None) -> tuple[Tensor, Tensor]:
        if y.shape[-1:] != (self.n_dofs,):
            raise ValueError(f"y must end in {self.n_dofs}, one value for each DoF, got {tuple(y.shape)}")
        if observed is None:
            observed = ~y.isnan()
        elif observed.dtype != torch.bool or observed.shape[-1:] != (self.n_dofs,):
            raise ValueError(
                f"observed must be bool and end in {self.n_dofs}, got {observed.dtype} {tuple(observed.shape)}"
            )
        bad = observed & ~y.isfinite()
        if bool(bad.any()):
            columns = bad.reshape(-1, self.n_dofs).any(0).nonzero().squeeze(-1).tolist()
            raise ValueError(f"y is NaN or infinite where it is observed, in DoFs {columns[:8]}; mark it False there")
        return y, observed.expand(y.shape)


class _Segment(NamedTuple):
    state: State
    phase: list[Tensor]
    log_likelihood: list[Tensor]
    projection: list[Tensor]
    kept: list[tuple[tuple[int, ...], State]]


def _checkpointed(
    run: Callable[..., _Segment], state: State, start: int, stop: int, generator: torch.Generator | None
) -> _Segment:
    """Run a segment so that its backward pass repeats it with the same draws.

    The global generator is saved by torch's own checkpointing; an explicit one is replayed from its state.
    """
    if generator is None:
        return checkpoint(run, state, start, stop, None, use_reentrant=False)  # type: ignore[no-any-return]
    beginning = generator.get_state()
    ends = []

    def replay(state: State) -> _Segment:
        """The segment with the draws of the first time."""
        again = torch.Generator(generator.device)
        again.set_state(beginning)
        done = run(state, start, stop, again)
        ends.append(again.get_state())
        return done

    done = checkpoint(replay, state, use_reentrant=False)
    generator.set_state(ends[0])
    return done  # type: ignore[no-any-return]


def _pick(state: State, here: Tensor) -> list[tuple[tuple[int, ...], State]]:
    """The entries of a batch that are to be kept now, with their place [*batch, K]."""
    if not bool(here.any()):
        return []
    places = [tuple(index) for index in here.nonzero().tolist()]

    def entry(index: tuple[int, ...], part: Tensor) -> Tensor:
        """One entry of the batch."""
        return part[index]

    return [(place, map_state(partial(entry, place[:-1]), state)) for place in places]


def _assemble(picked: list[tuple[tuple[int, ...], State]], shape: torch.Size) -> State:
    ordered = [state for _, state in sorted(picked, key=lambda pair: pair[0])]

    def stack(*parts: Tensor) -> Tensor:
        """The entries in their places, [*shape, ...]."""
        return torch.stack(parts).reshape(*shape, *parts[0].shape)

    return map_state(stack, *ordered)


def map_state(function: Callable[..., Tensor], *states: State) -> State:
    """Apply a function to the corresponding tensors of states, which may be nested and hold None."""
    first = states[0]
    if first is None:
        return None
    if isinstance(first, Tensor):
        return function(*states)
    return type(first)(*(map_state(function, *parts) for parts in zip(*states, strict=True)))
