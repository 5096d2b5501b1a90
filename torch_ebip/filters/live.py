"""The live path of an ensemble filter: in place and without gradients, for a robot's control loop and for studies.

It gives the same numbers as `EnsembleFilter.predict` and `EnsembleFilter.update` for the same draws, faster:

- what sensors do not see waits until a forecast asks for it (`SpanMembers`): a step does not pay for it;
- members are columns, so that phases, projections and features lie contiguously, and products go into the members;
- R is diagonal, and what depends on parameters alone is computed once;
- buffers are kept from step to step, a set for each set of DoFs that are measured together.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torch_ebip.ambient import in_own_modes
from torch_ebip.arguments import as_mask, as_number, as_values
from torch_ebip.draws import Generators, is_several, set_states, standard_normal, states_of
from torch_ebip.filters.base import Phases
from torch_ebip.filters.evidence import Evidence
from torch_ebip.filters.forecast import Forecast
from torch_ebip.filters.interaction import BasisProjection, ConstantVelocityPhase
from torch_ebip.filters.members import EnsembleState
from torch_ebip.filters.plan import Plan, kept, measured_dofs
from torch_ebip.filters.span import SpanMembers
from torch_ebip.functional.linear import FactorisationError, cholesky
from torch_ebip.functional.moments import member_shares
from torch_ebip.noise.process import InteractionNoise

if TYPE_CHECKING:
    from torch_ebip.filters.ensemble import EnsembleFilter


class LiveSnapshot(NamedTuple):
    """What `LiveFilter.save` keeps.

    Attributes:
        matrix: the members, [..., m, E], as `SpanMembers` has them.
        evidence: for demonstrations; never changed in place.
        growth: [...], product of all inflations so far; None where there is none.
        generators: their states, uint8 [bytes] each.
    """

    matrix: Tensor
    evidence: Evidence | None
    growth: Tensor | None
    generators: list[Tensor]


class LiveFilter:
    """An `EnsembleFilter` at work on one interaction, or on a batch of them in step.

    Its state is its own and changes with `predict` and `update`; `state` gives a copy that the filter understands.
    What depends on parameters is computed when it is first needed: after tuning, make a new one.

    Args:
        filter: made by `ebip` or `ebip_minus`.
        dofs: bool [D], those that may be measured; default: all. The fewer, the faster.
        batch_shape: leading dimensions, at most one.
        members: int64 [..., E], which demonstrations form the ensemble; default: see the filter's prior.
        generator: of all draws.
        state: where to start, batch dimensions ``batch_shape``; default: the filter's initial state.

    Raises:
        ValueError: a filter whose updates are no transform of its members (process noise on weights,
            localisation); no DoF that may be measured; more than one batch dimension.
        TypeError: a filter that is not one of an interaction primitive.
    """

    @in_own_modes
    @torch.no_grad()
    def __init__(
        self,
        filter: EnsembleFilter,
        dofs: Tensor | None = None,
        batch_shape: tuple[int, ...] = (),
        members: Tensor | None = None,
        generator: Generators = None,
        state: EnsembleState | None = None,
    ) -> None:
        reason = filter._leaves_span()
        if reason is not None:
            raise ValueError(f"a live filter transforms members as wholes, but {reason}; use the filter itself")
        if len(batch_shape) > 1:
            raise ValueError(f"a live filter has at most one batch dimension, got {list(batch_shape)}")
        if isinstance(generator, Sequence) and (not batch_shape or len(generator) != batch_shape[0]):
            raise ValueError(f"{len(generator)} generators for a batch {list(batch_shape)}: needs one for each entry")
        dofs = as_mask("dofs", [True] * filter.n_dofs if dofs is None else dofs, filter.n_dofs)
        if not bool(dofs.any()):
            raise ValueError(f"dofs must be bool [{filter.n_dofs}], some of them True: none may be measured")
        part = filter.restrict(dofs)
        assert isinstance(part.observation, BasisProjection)
        assert isinstance(part.dynamics, ConstantVelocityPhase)
        assert isinstance(part.noise.process, InteractionNoise)
        self.filter, self.generator, self.batch_shape = filter, generator, batch_shape
        self._part, self._hold, self._process = part, part.dynamics.hold, part.noise.process
        self._basis = part.observation.basis
        self._sensors = {dof: row for row, dof in enumerate(dofs.nonzero().squeeze(-1).tolist())}
        state = filter.initial_state(batch_shape, members, generator) if state is None else state
        if state.centre is None:  # made by hand
            state = filter._taken_out(state)
        start, centre = state.deviations, state.centre
        assert centre is not None  # a model with a live path has one
        self._start: Tensor = start
        self._centre: Tensor = centre
        self._evidence = state.evidence
        self._origin = None if state.evidence is None else state.evidence.origin
        columns = self._columns(dofs)
        if state.evidence is not None:
            self._evidence = state.evidence._replace(origin=state.evidence.origin[..., columns])
        self._span, self._middle = SpanMembers(start, columns), centre[..., 2 + columns]
        self._members = self._span.matrix
        self._phase, self._velocity = self._members[..., 0, :], self._members[..., 1, :]
        self._moving = self._members[..., :2, :]
        self._draws = start.new_empty(*start.shape[:-1], 2)
        self._draws_by_entry = self._draws.transpose(-1, -2)
        E = start.shape[-2]
        self._equal = start.new_full((*batch_shape, E, 1), 1 / E)
        self._growth = filter._grown(state)
        self._robust = filter.noise.robust
        self._changing_noise = bool(getattr(filter.noise.measurement, "depends_on_phase", True))
        self._factor: tuple[float, Tensor] | None = None
        self._terms = start.new_empty(math.prod(batch_shape) * len(columns) * E)
        self._plans: OrderedDict[tuple[bool, ...], Plan | None] = OrderedDict()
        self._add_product: Callable[..., Tensor] = Tensor.baddbmm_ if batch_shape else Tensor.addmm_
        self._plus_product: Callable[..., Tensor] = torch.baddbmm if batch_shape else torch.addmm
        self._forecasters: OrderedDict[tuple[bool, ...], tuple[EnsembleFilter, Tensor]] = OrderedDict()

    @property
    def state(self) -> EnsembleState:
        """A copy of everything, for `filter`."""
        return self.entry(None)

    @in_own_modes
    def entry(self, index: int | None) -> EnsembleState:
        """The state of one entry of the batch, without that dimension; of all for None."""
        return self._state(torch.arange(self._start.shape[-1] - 2, device=self._start.device), index)

    @property
    @in_own_modes
    def phase(self) -> Tensor:
        """Mean phase [...]."""
        even = self._equal if self._evidence is None else self._evidence.weights.unsqueeze(-1)
        return (self._phase.unsqueeze(-2) @ even).squeeze((-1, -2))

    @property
    @in_own_modes
    def phase_velocity(self) -> Tensor:
        """Mean phase velocity [...], 1/s."""
        even = self._equal if self._evidence is None else self._evidence.weights.unsqueeze(-1)
        return (self._velocity.unsqueeze(-2) @ even).squeeze((-1, -2))

    @property
    def finite(self) -> bool:
        """Whether members and weights are, and small enough for their variance to be."""
        flat = self._members.view(-1)
        size = float(torch.dot(flat, flat))
        return math.isfinite(size if self._evidence is None else size + float(self._evidence.weights.sum()))

    @in_own_modes
    @torch.no_grad()
    def save(self, into: LiveSnapshot | None = None) -> LiveSnapshot:
        """Everything that `predict` and `update` change, the generators' states included, for `load`.

        Args:
            into: an older snapshot of this filter, whose memory is used again.
        """
        matrix = self._members.clone() if into is None else into.matrix.copy_(self._members)
        return LiveSnapshot(matrix, self._evidence, self._growth, states_of(self.generator))

    @in_own_modes
    @torch.no_grad()
    def load(self, snapshot: LiveSnapshot) -> None:
        """Go back to a snapshot of this filter: what follows gives the same numbers again, to the bit.

        Draws too, if the filter has a generator; torch's global one is not turned back.
        """
        self._members.copy_(snapshot.matrix)
        self._evidence, self._growth = snapshot.evidence, snapshot.growth
        set_states(self.generator, snapshot.generators)

    @in_own_modes
    @torch.no_grad()
    def forecast(self, phase: Phases | None = None, dofs: Tensor | None = None) -> Forecast:
        """See `Filter.forecast`; of some dofs only, bool [D], if given, which costs less than all."""
        D = self.filter.n_dofs
        chosen = (True,) * D if dofs is None else tuple(as_mask("dofs", dofs, D).tolist())
        part, columns = kept(self._forecasters, chosen, self._make_forecaster)
        return part.forecast(self._state(columns), phase)

    @in_own_modes
    @torch.no_grad()
    def project(self, dofs: tuple[bool, ...]) -> Tensor:
        """[..., D_chosen], mean of h(x) of some of the sensors' DoFs, a bool for each DoF of the filter."""
        plan = kept(self._plans, dofs, self._make_plan)
        assert plan is not None
        even = self._equal if self._evidence is None else self._evidence.weights.unsqueeze(-1)
        return (plan.project(self._phase) @ even).squeeze(-1)

    @in_own_modes
    @torch.no_grad()
    def predict(self, dt: float | None = None) -> None:
        """Propagate by dt seconds; default: the time between samples of the demonstrations.

        Raises:
            ValueError: a dt that is negative, NaN or infinite.
        """
        dt = self.filter.dt if dt is None else dt
        if not (type(dt) is float and 0 <= dt < math.inf):  # most of all calls
            dt = as_number("dt", dt, 0, of="of seconds")
        if self._factor is None or self._factor[0] != dt:
            factor = self._process.phase_factor(self._phase.new_tensor(dt))
            self._factor = dt, factor.expand(*self.batch_shape, 2, 2)
        phase = self._phase.add_(self._velocity, alpha=dt)
        low, high = torch.aminmax(phase)
        if float(low) < 0 or float(high) > 1:
            phase.copy_(self._hold(phase))
        self._drawn(self._draws)
        self._add_product(self._moving, self._factor[1], self._draws_by_entry)
        if self._evidence is not None and self._part.weighting is not None:
            self._evidence = self._part.weighting.forget(self._evidence, self._phase.new_tensor(dt))

    @torch.no_grad()
    def update(self, y: Tensor, observed: Tensor | None = None) -> Tensor:
        """Take in one sample.

        Args:
            y: [..., D] in units of the DoFs: a tensor in the filter's dtype, an array or a list.
            observed: bool [..., D]; default: where y is not NaN.

        Returns:
            Log-likelihood [...] of the sample; 0 where nothing was measured, which changes nothing.

        Raises:
            ValueError: wrong shapes; infinity, or NaN where observed; a DoF that is none of the sensors'; an
                innovation covariance that cannot be factored. The state is then as before, but for the draws made.
        """
        if not isinstance(y, Tensor):
            y = as_values("y", y, self.filter.dof_names, self._members)
        if observed is not None and not isinstance(observed, Tensor):
            observed = torch.as_tensor(observed, device=y.device)
        return self.take(y, *measured_dofs(y, observed, self._members, self.batch_shape, self.filter.n_dofs))

    @in_own_modes
    @torch.no_grad()
    def take(self, y: Tensor, measured: tuple[bool, ...], mask: Tensor | None) -> Tensor:
        """`update` with arguments that were checked.

        Args:
            y: [..., D], units of the DoFs.
            measured: D, which DoFs some entry of the batch measured.
            mask: bool [B, D], which of them each entry did; None if all did.
        """
        plan = kept(self._plans, measured, self._make_plan)
        draws = None
        if is_several(self.generator) and not self.filter.square_root:
            # What one interaction draws may not depend on what others measure.
            E, D = self._members.shape[-1], self.filter.n_dofs
            draws = standard_normal((*self.batch_shape, E, D), self._members, self.generator)
        if plan is None:
            return self._members.new_zeros(self.batch_shape)
        values = torch.index_select(y, -1, plan.dofs, out=plan.values).unsqueeze(-1)
        E = self._members.shape[-1]
        weights = None if self._evidence is None else self._evidence.weights.unsqueeze(-1)
        even = self._equal if weights is None else weights
        projections = plan.project(self._phase)
        mean = projections @ even
        anomalies = torch.sub(projections, mean, out=plan.anomalies)
        # Once more: a mean of values far from 0 is rounded, and products need anomalies that sum to 0.
        anomalies.sub_(anomalies @ even)
        deviation, R = plan.measurement_noise(self._deviations)
        seen = None
        if mask is not None:
            seen = mask.index_select(-1, plan.dofs).unsqueeze(-1)
            deviation, R = plan.without(seen, deviation, R)
            anomalies.masked_fill_(~seen, 0)
        weighted, share = plan.anomalies_by_member, 1 / (E - 1)
        if weights is not None:
            weighted, share = weighted * member_shares(weighted, weights.squeeze(-1)), 1.0
        counts = None if seen is None else seen.to(values)
        if self._robust is not None:
            plan.check_finite(seen)
            spread = share * (anomalies * weighted.transpose(-1, -2)).sum(-1, keepdim=True)
            here = values if seen is None else torch.where(seen, values, 0)
            values, wider, trust = self._robust(here, mean, spread, deviation, self.filter.thinning)
            if seen is not None:
                wider, trust = torch.where(seen, wider, 0), torch.where(seen, trust, 0)
            R = R + torch.diag_embed((wider.square() - deviation.square())[..., 0])
            deviation, counts = wider, trust
        S = self._plus_product(R, anomalies, weighted, alpha=share)
        factor, info = torch.linalg.cholesky_ex(S)
        if bool(info.any() if self.batch_shape else info):
            self._explain(S, plan)
        residual = torch.sub(values, mean, out=plan.right_mean)
        if seen is not None:
            residual.masked_fill_(~seen, 0)
        if self.filter.square_root:
            shift = torch.cholesky_solve(residual, factor)
            half = torch.linalg.solve_triangular(factor + torch.diag_embed(deviation[..., 0]), anomalies, upper=False)
            moves = shift - torch.linalg.solve_triangular(factor.transpose(-1, -2), half, upper=True)
        else:
            if draws is None:
                self._drawn(plan.draws)
            else:
                torch.index_select(draws, -1, plan.dofs, out=plan.draws)
            # y + eps - HX, as (y - mean) + eps - HA: what is not measured is 0 in all of them.
            torch.addcmul(residual, deviation, plan.draws_by_dof, out=plan.right_members).sub_(anomalies)
            torch.cholesky_solve(plan.right, factor, out=plan.solved)
            moves, shift = plan.moves, plan.shift
        likelihood = plan.log_likelihood(factor, residual, shift, seen)
        if self._evidence is not None and self._part.weighting is not None:
            here = torch.ones_like(values, dtype=torch.bool) if seen is None else seen
            self._learn(
                self._evidence, plan, values[..., 0], here[..., 0], None if counts is None else counts[..., 0]
            )
        self._move(weighted, moves, share, even, counts)
        return likelihood

    def _drawn(self, buffer: Tensor) -> Tensor:
        """The buffer, filled with standard-normal draws: those that `standard_normal` would make."""
        generator = self.generator
        if generator is None or (isinstance(generator, torch.Generator) and generator.device == buffer.device):
            return buffer.normal_(generator=generator)
        return buffer.copy_(standard_normal(buffer.shape, buffer, self.generator))

    def _move(self, weighted: Tensor, moves: Tensor, share: float, even: Tensor, counts: Tensor | None) -> None:
        """X <- X + share (X weighted) moves in place, then inflated about its mean, the product with ``even``."""
        self._add_product(self._members, self._members @ weighted, moves, alpha=share)
        if self._growth is None:
            return
        whole = torch.ones_like(self._growth) if counts is None else counts.amax((-2, -1))
        inflation = self.filter._inflate(self._growth, whole)
        self._growth = self._growth * inflation
        self._members.lerp_(self._members @ even, (1 - inflation)[..., None, None])

    def _deviations(self) -> tuple[Tensor, bool]:
        """Standard deviations of all sensors' DoFs now, and whether they change with phase."""
        changing = self._changing_noise
        return self._part._deviation(self.phase if changing else None), changing

    def _make_plan(self, measured: tuple[bool, ...]) -> Plan | None:
        """Buffers for the DoFs that are measured together; None for none."""
        dofs = [dof for dof, here in enumerate(measured) if here]
        strangers = [dof for dof in dofs if dof not in self._sensors]
        if strangers:
            raise ValueError(
                f"DoFs {strangers[:8]} are measured, but are none of those this live filter was made for"
            )
        if not dofs:
            return None
        return Plan(self._basis, self._span, self._middle, dofs, [self._sensors[dof] for dof in dofs], self._terms)

    def _learn(self, evidence: Evidence, plan: Plan, values: Tensor, seen: Tensor, counts: Tensor | None) -> None:
        weighting = self._part.weighting
        assert weighting is not None
        phases = (self._phase.unsqueeze(-1) + weighting.offsets).clamp(0, 1)
        paths = self._basis.project_paths(phases, evidence.origin, plan.rows.tolist())
        columns = plan.rows if self._part.columns is None else self._part.columns[plan.rows]
        self._evidence = weighting.learn(evidence, paths, values, seen, self.phase, columns, counts)

    def _explain(self, S: Tensor, plan: Plan) -> None:
        try:
            cholesky(S, plan.dofs)
        except FactorisationError as error:
            raise self.filter._named(error, None) from error

    def _columns(self, dofs: Tensor) -> Tensor:
        """int64: which weights are those of some DoFs, bool [D]."""
        observation = self.filter.observation
        assert isinstance(observation, BasisProjection)
        return dofs[observation.basis.dof_of_weight()].nonzero().squeeze(-1).to(self._start.device)

    def _make_forecaster(self, chosen: tuple[bool, ...]) -> tuple[EnsembleFilter, Tensor]:
        dofs = torch.tensor(chosen, device="cpu")
        return (self.filter if all(chosen) else self.filter.restrict(dofs)), self._columns(dofs)

    def _state(self, columns: Tensor, entry: int | None = None) -> EnsembleState:
        evidence, origin, growth, centre = self._evidence, self._origin, self._growth, self._centre
        if entry is not None:
            growth, centre = None if growth is None else growth[entry], centre[entry]
        if evidence is not None and origin is not None:
            if entry is not None:
                evidence, origin = Evidence(*(part[entry] for part in evidence)), origin[entry]
            evidence = evidence._replace(origin=origin[..., columns])
        centre = torch.cat([centre[..., :2], centre[..., 2 + columns]], dim=-1)
        return EnsembleState(self._span.members(columns, entry), evidence, growth, centre)
