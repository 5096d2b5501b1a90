"""The contract of every filter: predict, update, a whole sequence, a forecast."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor, nn

from torch_ebip.ambient import eager, outside_inference
from torch_ebip.arguments import as_count, as_number, as_seconds, as_values
from torch_ebip.draws import Generators
from torch_ebip.filters.attribution import affine_coefficients
from torch_ebip.filters.forecast import Forecast
from torch_ebip.filters.model import InteractionModel, select_dofs
from torch_ebip.filters.sequence import Segment, State, assemble, checkpointed, map_state, pick
from torch_ebip.functional import FactorisationError
from torch_ebip.functional.linear import truth
from torch_ebip.meaning import Meaning
from torch_ebip.noise.pair import FilterNoise

Phases: TypeAlias = Tensor | Sequence[float] | float
"""Of a forecast."""


def as_phases(phase: Phases, like: Tensor) -> Tensor:
    """Phases [P] or [..., P] of a forecast, in the dtype and on the device of ``like``; one number is [1].

    Raises:
        ValueError: NaN or infinity, or no numbers at all.
    """
    if not isinstance(phase, Tensor):
        phase = as_values("phase", phase, None, like)
    phase = outside_inference(phase.to(like))
    if not bool(phase.isfinite().all()):
        raise ValueError("phases must be finite numbers, got NaN or infinity")
    return phase.reshape(1) if phase.ndim == 0 else phase


def _usable(state: State) -> State:
    """The state, a copy if it was made in inference mode and is used outside of it."""
    return map_state(outside_inference, state) if state[0].is_inference() else state


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


class Filter(Meaning, ABC):
    """A Bayesian filter over interactions, differentiable in its noise parameters.

    Args:
        dynamics: g, advances states by dt.
        observation: h, from states to values of the DoFs.
        noise: Q and R.
        prior: where states start.
        n_dofs: D.
        dt: seconds between samples where none is given.
        thinning: how many samples each one given stands for; see `restrict`.
        dof_names: for error messages.
    """

    def __init__(
        self,
        dynamics: nn.Module,
        observation: nn.Module,
        noise: FilterNoise,
        prior: nn.Module,
        n_dofs: int,
        dt: float,
        thinning: int = 1,
        dof_names: tuple[str, ...] | None = None,
    ) -> None:
        super().__init__()
        dt = as_number("dt", dt, 0, above=True, of="of seconds")
        self.dynamics = dynamics
        self.observation = observation
        self.noise = noise
        self.prior = prior
        self.n_dofs = as_count("n_dofs", n_dofs)
        self.dt = dt
        self.thinning = as_count("thinning", thinning)
        if dof_names is not None and len(dof_names) != n_dofs:
            raise ValueError(f"dof_names must be {n_dofs} names, one for each DoF, got {len(dof_names)}")
        self.dof_names = dof_names

    @abstractmethod
    def initial_state(
        self,
        batch_shape: tuple[int, ...] = (),
        members: Tensor | None = None,
        generator: Generators = None,
    ) -> State:
        """The state before any observation, at phase 0.

        Args:
            batch_shape: leading dimensions.
            members: int64 [..., E], which demonstrations form the ensemble; default: see the prior.
            generator: of the draws.
        """

    @abstractmethod
    def _predict(self, state: State, dt: Tensor, generator: Generators) -> State:
        """`predict` with dt as a tensor."""

    @abstractmethod
    def _update(self, state: State, y: Tensor, observed: Tensor, generator: Generators) -> tuple[State, Tensor]:
        """`update` with arguments that were checked."""

    @abstractmethod
    def project(self, state: State) -> Tensor:
        """[..., D], mean of h(x), units of the DoFs."""

    @abstractmethod
    def phase(self, state: State) -> Tensor:
        """[...], mean phase; NaN where the observation has no phase."""

    @abstractmethod
    def forecast(self, state: State, phase: Phases | None = None) -> Forecast:
        """The trajectory that the state implies.

        Args:
            state: of this filter.
            phase: [P] or [..., P], or one number; default: 50 phases evenly from the current one to 1.
        """

    @abstractmethod
    def restrict(self, dofs: Tensor, thinning: int = 1) -> Filter:
        """The same filter for some of the DoFs, sharing its parameters: not a copy.

        DoFs that are neither measured nor asked for influence nothing, so leaving out their weights is exact,
        and it saves their share of every update.

        Args:
            dofs: bool [D], those to keep.
            thinning: use it for sequences of which only every k-th sample is left: each stands for k, so R is
                divided by k, process noise follows, and the time between samples grows with it.

        Raises:
            TypeError: the filter is not one of an interaction primitive.
        """

    def attribution(self, state: State) -> Tensor:
        """Which demonstrations speak: the mean forecast is this affine combination of their trajectories.

        Each forecast's mean is sum_i c_i h(phase, w_i), because nothing ever leaves the span of the
        demonstrations. See `torch_ebip.filters.attribution`.

        Args:
            state: of this filter.

        Returns:
            c, [..., N], summing to 1.

        Raises:
            TypeError: the prior knows no demonstrations.
            ValueError: an option moves weights out of the span; says which.
        """
        states = getattr(self.prior, "states", None)
        if not isinstance(states, Tensor):
            raise TypeError(f"a {type(self.prior).__name__} knows no demonstrations that forecasts could rest on")
        reason = self._leaves_span()
        if reason is not None:
            raise ValueError(f"forecasts are no combination of the demonstrations: {reason}")
        return affine_coefficients(states[:, 2:], state.mean[..., 2:])

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: of which DoFs they are, in this order, at which rate."""
        dofs = f"{self.n_dofs} of them" if self.dof_names is None else ", ".join(self.dof_names)
        return f"dofs={dofs}; dt={self.dt / self.thinning:.9g}"

    def _leaves_span(self) -> str | None:
        """What moves weights out of the span of the demonstrations, if anything does."""
        return "weights have process noise" if getattr(self.noise.process, "weights", None) is not None else None

    @eager
    def predict(self, state: State, dt: float | Tensor, generator: Generators = None) -> State:
        """Propagate.

        Args:
            state: of this filter.
            dt: seconds: a number, or a tensor [...] with one for each entry of the batch.
            generator: of the draws.

        Raises:
            ValueError: a dt that is negative, NaN or infinite.
        """
        return self._predict(_usable(state), as_seconds(dt, state[0]), generator)

    @eager
    def update(
        self,
        state: State,
        y: Tensor,
        observed: Tensor | None = None,
        generator: Generators = None,
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
            ValueError: wrong shapes or dtypes; NaN or infinity where observed; an innovation covariance that cannot
                be factored.
        """
        return self._update(_usable(state), *self._checked(y, observed, state[0]), generator)

    @eager
    def forward(
        self,
        y: Tensor,
        observed: Tensor | None = None,
        dt: float | Tensor | None = None,
        state: State | None = None,
        generator: Generators = None,
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
            generator: of all draws; or one for each entry of the first batch dimension, so that its draws do not
                depend on its company.
            keep: int64 [..., K], after which samples (0 = the first) to keep the state of each entry.
            segment: samples a segment of gradient checkpointing; memory for gradients then grows with
                T / segment + segment instead of T, at the price of a second forward pass. Exact: every
                segment is recomputed with the draws it had.
            project: whether to compute `Trace.projection`.

        Raises:
            ValueError: wrong shapes or dtypes, NaN or infinity where observed, a step to keep that there is not, a dt
                that is negative, NaN or infinite.
        """
        like = next(self.parameters(), None) if state is None else state[0]
        y, observed = self._checked(y, observed, like)
        if y.ndim < 2 or y.shape[-2] < 1:
            raise ValueError(f"y must be [..., T, {self.n_dofs}] with at least one sample, got {tuple(y.shape)}")
        batch, length = y.shape[:-2], y.shape[-2]
        if generator is not None and not isinstance(generator, torch.Generator) and len(generator) != (*batch, 0)[0]:
            raise ValueError(f"{len(generator)} generators for a batch {list(batch)}: needs one for each entry")
        if segment is not None:
            segment = as_count("segment", segment)
        if state is None:
            state = self.initial_state(batch, generator=generator)
        elif state[0].shape[: len(batch)] != batch:
            raise ValueError(f"the state's batch does not begin with {list(batch)}: {list(state[0].shape)}")
        state = _usable(state)
        step = as_seconds(self.dt if dt is None else dt, state[0])
        if keep is not None:
            whole = not keep.is_floating_point() and keep.shape[:-1] == batch and keep.numel() > 0
            if not whole or int(keep.min()) < 0 or int(keep.max()) >= length:
                shape = ", ".join(map(str, batch))
                raise ValueError(f"keep must be [{shape}, K] with steps 0..{length - 1}, got {keep}")
        if not torch.is_grad_enabled():
            trace = self._without_gradients(
                y, observed, self.dt if dt is None else dt, state, generator, keep, project
            )
            if trace is not None:
                return trace

        def run(state: State, start: int, stop: int, generator: Generators) -> Segment:
            """Samples start to stop - 1."""
            record = Segment(state, [], [], [], [])
            for t in range(start, stop):
                if t > 0:
                    state = self._predict(state, step, generator)
                state, likelihood = self._update(state, y[..., t, :], observed[..., t, :], generator)
                record.log_likelihood.append(likelihood.expand(batch))
                record.phase.append(self.phase(state).expand(batch))
                record.projection.append(self.project(state) if project else state[0].new_zeros(*batch, 0))
                if keep is not None:
                    record.kept.extend(pick(state, keep == t))
            return record._replace(state=state)

        segments = []
        for start in range(0, length, segment or length):
            stop = min(start + (segment or length), length)
            execute = partial(checkpointed, run) if segment else run
            done = execute(state, start, stop, generator)
            state = done.state
            segments.append(done)
        return Trace(
            state,
            torch.stack([phase for part in segments for phase in part.phase], -1),
            torch.stack([value for part in segments for value in part.log_likelihood], -1),
            torch.stack([value for part in segments for value in part.projection], -2),
            None if keep is None else assemble([pick for part in segments for pick in part.kept], keep.shape),
        )

    def _without_gradients(
        self,
        y: Tensor,
        observed: Tensor,
        dt: float | Tensor,
        state: State,
        generator: Generators,
        keep: Tensor | None,
        project: bool,
    ) -> Trace | None:
        """`forward` by a faster way that a filter may have where no gradients are asked for; None if it has none."""
        return None

    def _phases_ahead(self, state: State) -> Tensor:
        """50 phases [..., 50] evenly from the current one to 1."""
        now = self.phase(state).clamp(0, 1).unsqueeze(-1)
        return now + (1 - now) * torch.linspace(0, 1, 50, dtype=now.dtype, device=now.device)

    def _deviation(self, phase: Tensor | None) -> Tensor:
        """Standard deviations of a sample, [D] or [..., D], at phases [...]; units of the DoFs."""
        deviation: Tensor = self.noise.measurement(phase) / math.sqrt(self.thinning)
        return deviation

    def _select(self, dofs: Tensor, thinning: int) -> InteractionModel:
        """The parts of a restricted filter; see `restrict`."""
        return select_dofs(self.dynamics, self.observation, self.noise, self.dt, self.dof_names, dofs, thinning)

    def _named(self, error: FactorisationError, rows: Tensor | None) -> ValueError:
        """The error of a factorisation over some DoFs, int64 [k] (None for all), with their names."""
        if self.dof_names is None:
            return error
        names = (self.dof_names[i if rows is None else int(rows[i])] for i in error.dofs)
        return ValueError(f"{error} ({', '.join(names)})")

    def _checked(self, y: Tensor, observed: Tensor | None, like: Tensor | None) -> tuple[Tensor, Tensor]:
        y = outside_inference(as_values("y", y, self.dof_names, like))
        if y.shape[-1:] != (self.n_dofs,):
            raise ValueError(f"y must end in {self.n_dofs}, one value for each DoF, got {tuple(y.shape)}")
        if observed is not None and not isinstance(observed, Tensor):
            observed = torch.as_tensor(observed, device=y.device)
        if observed is None:
            observed = ~y.isnan()
        elif observed.dtype != torch.bool or observed.shape[-1:] != (self.n_dofs,):
            raise ValueError(
                f"observed must be bool and end in {self.n_dofs}, got {observed.dtype} {tuple(observed.shape)}"
            )
        bad = observed & ~y.isfinite()
        if truth(bad.any(), "a filter takes batches itself: give it y [..., T, D] instead"):
            columns = bad.reshape(-1, self.n_dofs).any(0).nonzero().squeeze(-1).tolist()
            raise ValueError(f"y is NaN or infinite where it is observed, in DoFs {columns[:8]}; mark it False there")
        return y, observed.expand(y.shape)
