"""Members as rows of a tensor, [..., E, n], which autograd follows: any g and h, and every update."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.filtering import functional
from torch_ebip.filtering.carriers.carrier import Carrier, Measured
from torch_ebip.filtering.functional import Spread, Taper
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.states import EnsembleState
from torch_ebip.filtering.updates.rules import Rule


class DenseCarrier(Carrier):
    """The members of one state; an update leaves the state as it is and makes another, `state`.

    Args:
        model: of the members.
        state: not changed.
        y: [..., D], units of the DoFs.
        observed: bool [..., D], something of it True.

    Attributes:
        rows: int64 [K], the DoFs that some entry of the batch measured; None for all.
        projections: HX, [..., E, K].
        measured: over these DoFs.
    """

    def __init__(self, model: StateSpace, state: EnsembleState, y: Tensor, observed: Tensor) -> None:
        self._model, self._state, self._weights = model, state, state.weights
        self._members, self.memory = state.deviations, state.memory
        parts = model.split(state.deviations)
        self._moving = parts[0]
        measured = observed.reshape(-1, model.n_dofs).any(0)
        self.rows = rows = None if bool(measured.all()) else measured.nonzero().squeeze(-1)
        self.projections = model.project(state.deviations, rows, state.centre, parts)
        deviation = model.deviation(self.mean if model.noise_depends_on_state else None)
        if rows is not None:
            y, observed, deviation = y[..., rows], observed[..., rows], deviation[..., rows]
        self.measured = Measured(y, observed, deviation, rows)

    @property
    def state(self) -> EnsembleState:
        """What the members are now."""
        return EnsembleState(self._members, self.memory, self._state.centre)

    @property
    def moving(self) -> Tensor:
        """See `Carrier.moving`."""
        return self._moving

    @property
    def mean(self) -> Tensor:
        """See `Carrier.mean`."""
        return self._model.mean(self._moving, self._weights)

    def expected(self) -> Tensor:
        """See `Carrier.expected`."""
        return functional.ensemble_mean(self.projections, self._weights)

    def variance(self) -> Tensor:
        """See `Carrier.variance`."""
        return functional.ensemble_variance(self.projections, self._weights)

    def move(
        self, rule: Rule, measured: Measured, taper: Taper | None, spread: Spread, perturbations: Tensor | None
    ) -> Tensor:
        """See `Carrier.move`; perturbations [..., E, K]."""
        noise = torch.diag_embed(measured.deviation)
        weights, taper = self._weights, None if taper is None else taper.select(self.rows)
        innovation = functional.innovation_of(self.projections, measured.y, noise, measured.observed, taper, weights)
        assert innovation is not None
        moves = rule(innovation, perturbations)
        centred = self._state.centre is not None
        self._members = functional.apply_gain(moves, self._members, innovation, taper, weights, spread, centred)
        return functional.log_likelihood(innovation)
