"""The ensemble filter: the paper's steps over any dynamics g and any observation h."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip.common.draws import Generators, is_several, standard_normal
from torch_ebip.filtering import functional
from torch_ebip.filtering.carriers.dense import DenseCarrier
from torch_ebip.filtering.carriers.placing import placed
from torch_ebip.filtering.carriers.serving import why_not_span
from torch_ebip.filtering.centring import taken_out
from torch_ebip.filtering.in_place import filter_in_place
from torch_ebip.filtering.members import MemberFilter, NumbersItsStates
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.sequence import Filtered
from torch_ebip.filtering.states import EnsembleState
from torch_ebip.filtering.trace import Trace
from torch_ebip.filtering.updates.update import Update, analyse


class EnsembleFilter(MemberFilter):
    """Ensemble Kalman filter: the paper's with perturbed observations, unless the update says otherwise.

    Args:
        model: g, h and their noise.
        prior: maps (batch_shape, n_members, chosen, generator) to initial members [*batch_shape, E, n].
        n_members: E.
        update: what happens at a measurement; default: the paper's update, and nothing else.

    Raises:
        ValueError: fewer than two members; parts of the update that do not fit the model or the prior.

    Example:
        >>> import torch
        >>> from torch_ebip import EnsembleFilter, GaussianPrior, MeasurementNoise, SquareRoot, StateSpace, Update
        >>> class Still(torch.nn.Module):
        ...     def forward(self, x, *dt):
        ...         return x
        >>> model = StateSpace(Still(), Still(), None, MeasurementNoise(torch.ones(2)), ("x", "y"), dt=0.1)
        >>> filter = EnsembleFilter(model, GaussianPrior(torch.zeros(2), torch.eye(2)), 50, Update(SquareRoot()))
        >>> filter(torch.zeros(30, 2)).states.shape
        torch.Size([30, 2])
    """

    def __init__(self, model: StateSpace, prior: nn.Module, n_members: int, update: Update | None = None) -> None:
        super().__init__(model, prior, n_members)
        self.analysis = Update() if update is None else update
        if self.analysis.weighting is not None and not isinstance(prior, NumbersItsStates):
            raise ValueError(
                f"a {type(self.analysis.weighting).__name__} asks as which of the prior's states members started, "
                f"which a {type(prior).__name__} does not know"
            )
        for part in self.analysis.parts:
            part.check(model)

    def _start(
        self, batch_shape: tuple[int, ...], chosen: Tensor | None, generator: Generators, known: Tensor | None
    ) -> EnsembleState:
        """Step 1 of the paper's algorithm."""
        members, origin = self._members(batch_shape, chosen, generator)
        memory = self.analysis.start(members, origin)
        if self.analysis.pace is not None:
            memory = memory._replace(pace=self._paced(self.analysis.pace, members, chosen, known))
        return taken_out(self.model, EnsembleState(members, memory))

    def _predict(self, state: EnsembleState, dt: Tensor, generator: Generators) -> EnsembleState:
        """Step 2: x = g(x) + N(0, Q)."""
        memory, dt = self.analysis.elapse(self.analysis.complete(state.memory, state.deviations), dt)
        return EnsembleState(self.model.advance(state.deviations, dt, generator), memory, state.centre)

    def _update(
        self, state: EnsembleState, y: Tensor, observed: Tensor, generator: Generators
    ) -> tuple[EnsembleState, Tensor]:
        """Step 3: x = x + K (y + eps - h(x)), over the DoFs that some entry of the batch measured."""
        state = state._replace(memory=self.analysis.complete(state.memory, state.deviations))
        perturbs, draws = self.analysis.rule.perturbs, None
        if perturbs and is_several(generator):
            # What one sequence draws may not depend on what others measure.
            draws = standard_normal((*state.deviations.shape[:-1], self.n_dofs), state.deviations, generator)
        if not bool(observed.any()):
            return state, state.deviations.new_zeros(observed.shape[:-1])
        if self.analysis.pace is not None:
            state = placed(self.analysis.pace, self.model, state, y, observed, self.first)
        carrier = DenseCarrier(self.model, state, y, observed)
        if draws is not None and carrier.rows is not None:
            draws = draws[..., carrier.rows]
        elif draws is None and perturbs:
            draws = standard_normal(carrier.projections.shape, state.deviations, generator)
        try:
            likelihood = analyse(self.analysis.slots, carrier, carrier.measured, draws)
        except functional.FactorisationError as error:
            raise self.model.named(error, carrier.rows) from error
        return carrier.state, likelihood

    def first(self, state: EnsembleState) -> Tensor | None:
        """How the members of a state started, [..., E, n]; None if nobody knows."""
        origin = state.memory.origin
        if origin is None or not isinstance(self.prior, NumbersItsStates):
            return None
        return self.prior.start(state.deviations.shape[:-2], origin.shape[-1], origin, None)[0]

    def _centre(self, state: EnsembleState) -> Tensor | None:
        """See `MemberFilter._centre`."""
        return state.centre

    def _narrow(self, view: View) -> None:
        """See `Filter._narrow`."""
        self.analysis = self.analysis.select(view)

    @property
    def has_live_path(self) -> bool:
        """Whether a `LiveFilter` can be made of it; see `torch_ebip.filtering.carriers`."""
        return why_not_span(self.model, self.analysis) is None

    def _why_not_span(self, y: Tensor, dt: float | Tensor | None, state: EnsembleState) -> str | None:
        """Why a sequence that was checked cannot be filtered by the span engine; None if it can."""
        if torch.is_grad_enabled():
            return "gradients are recorded, which it has none of: use torch.no_grad()"
        if (state.memory.weighting is None) != (self.analysis.weighting is None):
            return "a state made by hand does not say as which demonstrations its members started"
        if isinstance(dt, Tensor):
            return "entries of the batch have a dt of their own: give it a number of seconds"
        if y.ndim > 3 or state.deviations.shape[:-2] != y.shape[:-2]:
            return f"it has one batch dimension at most, that of its state, got {list(y.shape[:-2])}"
        if y.dtype != state.deviations.dtype:
            return f"y is {y.dtype}, the state {state.deviations.dtype}"
        return why_not_span(self.model, self.analysis)

    def _through_span(
        self,
        y: Tensor,
        observed: Tensor,
        dt: float | Tensor | None,
        state: EnsembleState,
        generator: Generators,
        keep: Tensor | None,
        project: bool,
    ) -> Trace | str:
        """See `Filter._through_span`."""
        reason = self._why_not_span(y, dt, state)
        if reason is not None:
            return reason
        seconds = self.dt if dt is None else float(dt)
        first = None if self.analysis.pace is None else self.first(state)
        done = filter_in_place(
            self.model, self.analysis, y, observed, seconds, state, generator, keep, project, first
        )
        return self._traced(done, "span")

    def _traced(self, done: Filtered, engine: str) -> Trace:
        """See `Filter._traced`."""
        surprise, felt = self.analysis.surprise, done.felt
        if surprise is None or felt is None:
            return super()._traced(done, engine)
        return self._trace(*done[:5], engine, surprise.familiarity(felt), felt.level, felt.counts)

    def _parts(self) -> list[str]:
        """See `Filter._parts`."""
        return [type(part).__name__ for part in self.analysis.parts]

    def extra_repr(self) -> str:
        """The options that are not modules."""
        return f"n_members={self.n_members}, stride={self.stride}"
