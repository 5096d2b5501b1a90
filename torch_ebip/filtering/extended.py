"""The extended Kalman filter: a mean and a covariance, moved by derivatives that the model knows.

With a model whose dynamics touch few entries and whose DoFs depend on few, as an interaction's, a step costs
O(n^2 D): nothing multiplies n x n by n x n. The equations are those of the paper's Section III-B.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import eager
from torch_ebip.common.brief import brief
from torch_ebip.common.draws import Generators
from torch_ebip.filtering.base import Filter
from torch_ebip.filtering.functional import FactorisationError, add_product, cholesky
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.trust import RobustWeights


@runtime_checkable
class MovesCovariance(Protocol):
    """Dynamics that know their Jacobian G."""

    def moved_covariance(self, mean: Tensor, covariance: Tensor, dt: Tensor) -> Tensor:
        """G Sigma G', [..., n, n], at a mean [..., n], for dt [...] seconds; a tensor that nobody else holds."""


@runtime_checkable
class AddsCovariance(Protocol):
    """A process noise that knows its covariance Q."""

    def add_covariance_(self, covariance: Tensor, dt: Tensor) -> Tensor:
        """Sigma + Q, [..., n, n], in place, for dt [...] seconds."""


@runtime_checkable
class HasJacobian(Protocol):
    """A measurement that knows its Jacobian H."""

    def jacobian(self, mean: Tensor) -> Callable[[Tensor], Tensor]:
        """The product with H' at a mean [..., n]: a function from matrices [..., m, n] to [..., m, D]."""


class GaussianState(NamedTuple):
    """A normal distribution of the state.

    Attributes:
        mean: [..., n].
        covariance: [..., n, n], symmetric to rounding.
    """

    mean: Tensor
    covariance: Tensor

    def __repr__(self) -> str:
        return brief(self)


class ExtendedFilter(Filter):
    """Extended Kalman filter; the covariance update is Joseph's, which keeps it positive.

    Args:
        model: whose dynamics, process noise and measurement know their Jacobians and covariance (`MovesCovariance`,
            `AddsCovariance`, `HasJacobian`).
        prior: maps (batch_shape, chosen) to mean [..., n] and covariance [..., n, n].
        trust: what surprising values count, each on top of those before it.

    Raises:
        ValueError: a part of the model that does not know its derivative.
    """

    def __init__(self, model: StateSpace, prior: nn.Module, trust: Iterable[RobustWeights] = ()) -> None:
        super().__init__(model, prior)
        for part, protocol, method in (
            (model.dynamics, MovesCovariance, "moved_covariance"),
            (model.process_noise, AddsCovariance, "add_covariance_"),
            (model.measurement, HasJacobian, "jacobian"),
        ):
            if not isinstance(part, protocol):
                raise ValueError(f"an extended filter needs derivatives: a {type(part).__name__} has no `{method}`")
        self.trust = nn.ModuleList(trust)

    def _start(
        self, batch_shape: tuple[int, ...], chosen: Tensor | None, generator: Generators, known: Tensor | None
    ) -> GaussianState:
        """The equations of mu_0 and Sigma_0."""
        return GaussianState(*self.prior(batch_shape, chosen))

    def _predict(self, state: GaussianState, dt: Tensor, generator: Generators) -> GaussianState:
        """mu = g(mu), Sigma = G Sigma G' + Q."""
        mean, covariance = state
        dynamics, process = self.model.dynamics, self.model.process_noise
        assert isinstance(dynamics, MovesCovariance)
        assert isinstance(process, AddsCovariance)
        moved = process.add_covariance_(dynamics.moved_covariance(mean, covariance, dt), dt)
        return GaussianState(self.model.dynamics(mean.unsqueeze(-2), dt).squeeze(-2), moved)

    def _update(
        self, state: GaussianState, y: Tensor, observed: Tensor, generator: Generators
    ) -> tuple[GaussianState, Tensor]:
        """K = Sigma H' S^-1, mu = mu + K (y - h(mu)), Sigma = (I - K H) Sigma (I - K H)' + K R K'."""
        measured = observed.reshape(-1, self.n_dofs).any(0)
        mean, covariance = state
        if not bool(measured.any()):
            return state, mean.new_zeros(observed.shape[:-1])
        model, rows = self.model, None if bool(measured.all()) else measured.nonzero().squeeze(-1)
        deviation = model.deviation(self.moving(state) if model.noise_depends_on_state else None)
        y, observed, deviation = (_rows(part, rows) for part in (y, observed, deviation))
        by_jacobian = self._by_jacobian(mean, rows, observed)
        cross_covariance = by_jacobian(covariance)  # Sigma H', [..., n, D]
        innovation = by_jacobian(cross_covariance.transpose(-1, -2))
        innovation = 0.5 * (innovation + innovation.transpose(-1, -2))
        values = torch.where(observed, y, 0)
        predicted = torch.where(observed, _rows(self.project(state), rows), 0)
        for weigh in self.trust:
            spread = innovation.diagonal(dim1=-2, dim2=-1)
            values, deviation, _ = weigh(values, predicted, spread, deviation)
        R = torch.where(observed, deviation.square(), 0)
        S = innovation + torch.diag_embed(torch.where(observed, R, 1))
        scale = S.diagonal(dim1=-2, dim2=-1).sqrt()
        try:
            factor = cholesky(S / (scale.unsqueeze(-1) * scale.unsqueeze(-2)), rows)
        except FactorisationError as error:
            raise model.named(error, None) from error  # its DoFs are numbered as in the filter
        residual = values - predicted
        K = torch.cholesky_solve(cross_covariance.transpose(-1, -2) / scale.unsqueeze(-1), factor)
        K = (K / scale.unsqueeze(-1)).transpose(-1, -2)
        mean = mean + (K @ residual.unsqueeze(-1)).squeeze(-1)
        # Joseph's (I - KH) Sigma (I - KH)' + K R K' is Sigma - K B' - B K' with B = Sigma H' - K S / 2: one product.
        half = cross_covariance - 0.5 * K @ (innovation + torch.diag_embed(R))
        pair = torch.cat([K, half], dim=-1)
        other = torch.cat([half, K], dim=-1)
        joseph = add_product(covariance, -pair, other.transpose(-1, -2))
        whitened = torch.linalg.solve_triangular(factor, (residual / scale).unsqueeze(-1), upper=False).squeeze(-1)
        log_scale = factor.diagonal(dim1=-2, dim2=-1).log() + scale.log()
        terms = -0.5 * whitened.square() - log_scale - 0.5 * math.log(2 * math.pi)
        return GaussianState(mean, joseph), torch.where(observed, terms, 0).sum(-1)

    def _by_jacobian(self, mean: Tensor, rows: Tensor | None, observed: Tensor) -> Callable[[Tensor], Tensor]:
        """Product with H', [..., m, n] -> [..., m, D], over some rows of H; those not observed count as 0."""
        measurement = self.model.measurement
        assert isinstance(measurement, HasJacobian)
        product = measurement.jacobian(mean)
        return lambda matrix: torch.where(observed.unsqueeze(-2), _rows(product(matrix), rows), 0)

    def _narrow(self, view: View) -> None:
        """See `Filter._narrow`."""
        self.trust = nn.ModuleList([trust.select(view) for trust in self.trust])  # type: ignore[operator]

    @eager
    def project(self, state: GaussianState) -> Tensor:
        """h(mu), [..., D], of a state."""
        return self.model.project(state.mean.unsqueeze(-2)).squeeze(-2)

    def moving(self, state: GaussianState) -> Tensor:
        """[..., m], of the mean of a state; see `Filter.moving`."""
        return self.model.split(state.mean)[0]

    def _parts(self) -> list[str]:
        """See `Filter._parts`."""
        return [type(trust).__name__ for trust in self.trust]

    def extra_repr(self) -> str:
        """The options that are not modules."""
        return f"stride={self.stride}"


def _rows(values: Tensor, rows: Tensor | None) -> Tensor:
    return values if rows is None else values[..., rows]
