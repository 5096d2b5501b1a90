"""Members that stay in the span of where they started, changed in place and without gradients.

It gives the same numbers as the dense carrier for the same draws, faster:

- what sensors do not see waits until somebody asks for it (`ColumnMembers`): a step does not pay for it;
- members are columns, so that what moves, projections and features lie contiguously, and products go into the
  members;
- R is diagonal, and what depends on parameters alone is computed when one of them has changed;
- buffers are kept from step to step, a set for each set of DoFs that are measured together (`Plan`).

It serves a model of which a part neither moves nor is stirred, if its parts speak the protocols that `why_not_span`
asks for, and an update that mixes whole members.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torch_ebip.common.draws import Generators, fill_standard_normal, is_several, standard_normal
from torch_ebip.common.modules import Versions
from torch_ebip.filtering.carriers.carrier import Carrier, Measured
from torch_ebip.filtering.carriers.checks import explain
from torch_ebip.filtering.carriers.columns import ColumnMembers
from torch_ebip.filtering.carriers.placing import place_columns
from torch_ebip.filtering.carriers.plan import Plan, Plans
from torch_ebip.filtering.carriers.serving import AdvancesColumns, HasFactor, ProjectsColumns, why_not_span
from torch_ebip.filtering.carriers.step_noise import StepNoise
from torch_ebip.filtering.centring import taken_out
from torch_ebip.filtering.functional.innovation import Taper
from torch_ebip.filtering.functional.moments import member_shares
from torch_ebip.filtering.functional.update import Spread
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.states import EnsembleState, Memory, map_state
from torch_ebip.filtering.updates.rules import Columns, Rule
from torch_ebip.filtering.updates.update import Update, analyse
from torch_ebip.filtering.updates.weighting import Seen


class SpanCarrier(Carrier):
    """The members of one sequence, or of a batch of them in step, at work.

    Args:
        model, update: that it serves, see `why_not_span`.
        sensors: bool [D], the DoFs that may be measured. The fewer, the faster.
        state: where to start.
        generator: of all draws.
        first: how members started, [..., E, n], for a `Pace`; None where nobody knows.

    Raises:
        ValueError: a model or an update that it cannot serve: says why.
    """

    def __init__(
        self,
        model: StateSpace,
        update: Update,
        sensors: Tensor,
        state: EnsembleState,
        generator: Generators,
        first: Tensor | None = None,
    ) -> None:
        reason = why_not_span(model, update)
        if reason is not None:
            raise ValueError(f"members cannot be transformed as wholes: {reason}; use the dense engine")
        view = model.view(sensors)
        part = model.select(view)
        assert isinstance(part.dynamics, AdvancesColumns)
        assert isinstance(part.process_noise, HasFactor)
        assert isinstance(part.measurement, ProjectsColumns)
        assert part.moving is not None
        self._whole, self._model, self._generator = model, part, generator
        self._update = update.select(view)
        if self._update.weighting is not None:
            self._update.weighting.at_work()
        self._slots, self._depends_on_state = self._update.slots, part.noise_depends_on_state
        if state.centre is None:  # made by hand
            state = taken_out(model, state)
        assert state.centre is not None
        start, self._centre = state.deviations, state.centre
        self.memory = update.complete(state.memory, start)
        self.batch_shape, m = tuple(start.shape[:-2]), part.moving
        seen = view.state[m:] - m
        first = None if first is None else first - state.centre.unsqueeze(-2)
        self._columns = ColumnMembers(start, seen, m, first)
        self.matrix, self._moving = self._columns.matrix, self._columns.moving
        self._advance = part.dynamics.advancer(self._moving)
        self._mean: Tensor | None = None  # as it is; None: to be computed
        self._products: Tensor | None = None  # of anomalies of what is measured, likewise
        E = start.shape[-2]
        self._draws = start.new_empty(*start.shape[:-1], m)
        self._draws_by_entry = self._draws.transpose(-1, -2)
        self._equal = start.new_full((*self.batch_shape, E, 1), 1 / E)
        terms = start.new_empty(math.prod(self.batch_shape) * len(seen) * E)
        middle = state.centre[..., view.state[m:]]
        self._plans = Plans(part.measurement, self._columns, middle, view.dofs.tolist(), terms)
        self._noise_versions = Versions(part.measurement_noise)
        self._steps = StepNoise(part.process_noise, self.matrix)
        batched = bool(self.batch_shape)
        self._add_product: Callable[..., Tensor] = Tensor.baddbmm_ if batched else Tensor.addmm_
        self._product: Callable[..., Tensor] = torch.bmm if batched else torch.mm

    @property
    def moving(self) -> Tensor:
        """See `Carrier.moving`: a view."""
        return self._moving.transpose(-1, -2)

    @property
    def mean(self) -> Tensor:
        """See `Carrier.mean`."""
        if self._mean is None:
            self._mean = (self._moving @ self._even).squeeze(-1)
        return self._mean

    @property
    def finite(self) -> bool:
        """Whether members and weights are, and small enough for their variance to be."""
        flat = self.matrix.view(-1)
        size = float(torch.dot(flat, flat))
        weighting = self.memory.weighting
        return math.isfinite(size if weighting is None else size + float(weighting.weights.sum()))

    def state(self, columns: Tensor | None = None, entry: int | None = None) -> EnsembleState:
        """A copy of everything, for the filter.

        Args:
            columns: int64 [k], which of the entries that stand still; default: all.
            entry: of the batch, without that dimension; default: all of it.
        """
        memory, centre, m = self.memory, self._centre, self._moving.shape[-2]
        if columns is None:
            columns = torch.arange(centre.shape[-1] - m, device=centre.device)
        if entry is not None:
            centre = centre[entry]
            memory = map_state(lambda part: part[entry], memory)
        centre = torch.cat([centre[..., :m], centre[..., m + columns]], dim=-1)
        return EnsembleState(self._columns.members(columns, entry), memory, centre)

    def restore(self, matrix: Tensor, memory: Memory) -> None:
        """Go back to a copy of the ``matrix`` [..., m + k, E], and to the memory that went with it."""
        self.matrix.copy_(matrix)
        self.memory, self._mean = memory, None

    def predict(self, dt: float) -> None:
        """x = g(x) + N(0, Q) over dt seconds, finite and not negative."""
        seconds, factor = self._steps.of(dt)
        memory = self.memory
        self._mean = None
        if memory.pace is not None:
            self.memory, gone = self._update.elapse(memory, seconds)
            self._advance(dt if gone is seconds else gone)
            factor = factor if gone is seconds else self._steps.noise.factor(gone)
        else:
            if memory.weighting is not None or memory.surprise is not None or memory.recent is not None:
                self.memory = self._update.forget(memory, seconds)
            self._advance(dt)
        fill_standard_normal(self._draws, self._generator)
        self._add_product(self._moving, factor, self._draws_by_entry)

    def take(self, y: Tensor, measured: tuple[bool, ...], mask: Tensor | None) -> Tensor:
        """Take in one sample that was checked.

        Args:
            y: [..., D], units of the DoFs.
            measured: D, which DoFs some entry of the batch measured.
            mask: bool [B, D], which of them each entry did; None if all did.

        Returns:
            Log-likelihood [...].

        Raises:
            ValueError: see `LiveFilter.update`.
        """
        plan = self._plans.of(measured)
        perturbs, draws = self._slots.rule.perturbs, None
        if perturbs and is_several(self._generator):
            # What one sequence draws may not depend on what others measure.
            shape = (*self.batch_shape, self.matrix.shape[-1], self._whole.n_dofs)
            draws = standard_normal(shape, self.matrix, self._generator)
        if plan is None:
            return self.matrix.new_zeros(self.batch_shape)
        if draws is not None:
            torch.index_select(draws, -1, plan.dofs, out=plan.draws)
        elif perturbs:
            fill_standard_normal(plan.draws, self._generator)
        before, former = self.memory, self._place(plan, y, mask)
        try:
            sample = self._measure(plan, y, mask)
            return analyse(self._slots, self, sample, plan.draws_by_dof if perturbs else None)
        except ValueError:  # a sample that cannot be taken in leads nobody
            self.restore(self.matrix if former is None else former, before)
            raise

    def expected(self) -> Tensor:
        """See `Carrier.expected`."""
        return self._plan.mean

    def variance(self) -> Tensor:
        """See `Carrier.variance`; what is NaN or infinite would pass for far off, so it is refused here."""
        self._plan.check_finite(self._seen)
        self._products = products = self._product(self._plan.anomalies, self._weighted)
        return self._share * products.diagonal(dim1=-2, dim2=-1)

    def move(
        self, rule: Rule, measured: Measured, taper: Taper | None, spread: Spread, perturbations: Tensor | None
    ) -> Tensor:
        """See `Carrier.move`; perturbations [..., K, E]."""
        self._mean = None
        plan, seen, weighted, even = self._plan, self._seen, self._weighted, self._shares
        y, deviation, R = plan.values_by_dof, self._deviation, self._R
        if measured is not self._measured:  # other values and deviations are believed
            y, believed = measured.y.unsqueeze(-1), measured.deviation.unsqueeze(-1)
            R = R + torch.diag_embed((believed.square() - deviation.square())[..., 0])
            deviation = believed
        products = self._product(plan.anomalies, weighted) if self._products is None else self._products
        S = torch.add(R, products, alpha=self._share)
        factor, info = torch.linalg.cholesky_ex(S)
        if bool(info.any() if self.batch_shape else info):
            explain(S, plan.dofs, self._whole)
        residual = torch.sub(y, plan.mean_by_dof, out=plan.residual)
        if seen is not None:
            residual.masked_fill_(~seen, 0)
        moves, shift = rule.columns(Columns(plan.anomalies, residual, deviation, factor, *plan.solver), perturbations)
        likelihood = plan.log_likelihood(factor, residual, shift, seen)
        if spread.keep is not None:
            moves = torch.lerp(moves @ even, moves, spread.keep[..., None, None])
        self._add_product(self.matrix, self._product(self.matrix, weighted), moves, alpha=self._share)
        if spread.scale is not None:
            scale = spread.scale if seen is None else torch.where(seen.any(-2)[..., 0], spread.scale, 1)
            self.matrix.lerp_(self.matrix @ even, (1 - scale)[..., None, None])
        return likelihood

    def project(self, dofs: tuple[bool, ...]) -> Tensor:
        """[..., K], mean of h(x) of some of the sensors' DoFs, a bool for each DoF of the filter."""
        plan = self._plans.of(dofs)
        assert plan is not None
        return (plan.project() @ self._even).squeeze(-1)

    def _measure(self, plan: Plan, y: Tensor, mask: Tensor | None) -> Measured:
        """What is measured and what is expected; the anomalies are left in the plan."""
        torch.index_select(y, -1, plan.dofs, out=plan.values)
        weighting = self.memory.weighting
        self._shares = even = self._even
        projections = plan.project()
        mean = self._product(projections, even, out=plan.mean_by_dof)
        anomalies = torch.sub(projections, mean, out=plan.anomalies)
        # Once more: a mean of values far from 0 is rounded, and products need anomalies that sum to 0.
        anomalies.sub_(self._product(anomalies, even))
        deviations, deviation, R = self._believed(plan)
        seen = None
        if mask is not None:
            seen = mask.index_select(-1, plan.dofs).unsqueeze(-1)
            one = torch.eye(R.shape[-1], dtype=R.dtype, device=R.device)
            deviation, R = torch.where(seen, deviation, 0), torch.where(seen, R, one)
            deviations = deviation.squeeze(-1)
            anomalies.masked_fill_(~seen, 0)
        self._weighted, self._share = plan.anomalies_by_member, 1 / (anomalies.shape[-1] - 1)
        if weighting is not None:
            self._weighted = self._weighted * member_shares(self._weighted, weighting.weights)
            self._share = 1.0
        self._plan, self._seen, self._deviation, self._R, self._products = plan, seen, deviation, R, None
        observed = None if seen is None else seen.squeeze(-1)
        self._measured = Measured(plan.values, observed, deviations, plan.rows)
        return self._measured

    def _place(self, plan: Plan, y: Tensor, mask: Tensor | None) -> Tensor | None:
        """Lead the members where the pace has them, now that a sample was seen; what they were, if they were led."""
        pace, memory = self._slots.pace, self.memory
        if pace is None or memory.pace is None:
            return None
        observed = None if mask is None else mask.index_select(-1, plan.dofs)
        values = y.index_select(-1, plan.dofs)
        seen = Seen(values, observed, None, plan.rows, self.moving, self.mean, memory.origin)
        remembered, placement = pace.notice(memory.pace, seen)
        self.memory = memory._replace(pace=remembered)
        if placement is None:
            return None
        former = self.matrix.clone()
        place_columns(self._columns, self.mean, placement)
        self._mean = None
        return former

    def _believed(self, plan: Plan) -> tuple[Tensor, Tensor, Tensor]:
        """R of a plan's DoFs, kept while no parameter changes, unless it depends on the state."""
        if self._depends_on_state:
            return plan.believe(self._model.deviation(self.mean))
        if self._noise_versions.changed():
            self._plans.forget_noise()
        if plan.noise is None:
            plan.noise = plan.believe(self._model.deviation(None))
        return plan.noise

    @property
    def _even(self) -> Tensor:
        """What each member counts in a mean, [..., E, 1]."""
        weighting = self.memory.weighting
        return self._equal if weighting is None else weighting.weights.unsqueeze(-1)
