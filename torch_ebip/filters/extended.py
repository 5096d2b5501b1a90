"""The extended Kalman filter of the paper's predecessor, Bayesian Interaction Primitives: Section III-B.

The equations of mu and Sigma, of the Jacobian H_t and of the measurement update, in O(n^2 D) a step: G differs
from the identity in one entry, and each row of H_t has only the weights of its own DoF and the phase, so a
product of a covariance with H_t' costs one multiplication an entry. Nothing multiplies n x n by n x n.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.ambient import eager
from torch_ebip.basis.base import Basis
from torch_ebip.draws import Generators
from torch_ebip.filters.base import Filter, Phases, as_phases
from torch_ebip.filters.forecast import Forecast
from torch_ebip.filters.interaction import BasisProjection, ConstantVelocityPhase
from torch_ebip.filters.model import demonstration_states, interaction_model
from torch_ebip.filters.priors import MomentPrior
from torch_ebip.functional import FactorisationError, add_product, cholesky
from torch_ebip.noise.pair import FilterNoise
from torch_ebip.noise.process import InteractionNoise
from torch_ebip.noise.robust import RobustWeights
from torch_ebip.primitive import InteractionPrimitive


class GaussianState(NamedTuple):
    """A normal distribution of the state.

    Attributes:
        mean: [..., n].
        covariance: [..., n, n], symmetric to rounding.
    """

    mean: Tensor
    covariance: Tensor


class ExtendedFilter(Filter):
    """Extended Kalman filter of an interaction; the covariance update is Joseph's, which keeps it positive.

    Args:
        dynamics: g.
        observation: h, whose Jacobian is known.
        noise: Q and R.
        prior: maps (batch_shape, members) to mean [..., n] and covariance [..., n, n].
        n_dofs, dt, thinning, dof_names: see `Filter`.
    """

    def __init__(
        self,
        dynamics: ConstantVelocityPhase,
        observation: BasisProjection,
        noise: FilterNoise,
        prior: MomentPrior,
        n_dofs: int,
        dt: float,
        thinning: int = 1,
        dof_names: tuple[str, ...] | None = None,
    ) -> None:
        super().__init__(dynamics, observation, noise, prior, n_dofs, dt, thinning, dof_names)

    @eager
    def initial_state(
        self,
        batch_shape: tuple[int, ...] = (),
        members: Tensor | None = None,
        generator: Generators = None,
    ) -> GaussianState:
        """The equations of mu_0 and Sigma_0, of all demonstrations or of those named; see `Filter.initial_state`."""
        return GaussianState(*self.prior(batch_shape, members))

    def _predict(self, state: GaussianState, dt: Tensor, generator: Generators) -> GaussianState:
        """mu = g(mu), Sigma = G Sigma G' + Q: only the row and the column of the phase change, and Q's blocks."""
        mean, covariance = state
        slope = self._dynamics.slope(mean, dt).unsqueeze(-1)
        dt_column = dt.unsqueeze(-1)
        row = slope * (covariance[..., 0, :] + dt_column * covariance[..., 1, :])
        corner = slope.squeeze(-1) * (row[..., 0] + dt * row[..., 1])
        row = torch.cat([corner.unsqueeze(-1), row[..., 1:]], dim=-1)
        # What rounding made asymmetric does not pile up.
        moved = torch.lerp(covariance, covariance.transpose(-1, -2), 0.5)
        moved[..., 0, :] = row
        moved[..., :, 0] = row
        phase, weights = self._process.covariance(dt)
        moved[..., :2, :2] += phase
        if weights is not None:
            moved[..., 2:, 2:].diagonal(dim1=-2, dim2=-1).add_(weights)
        return GaussianState(self._dynamics(mean.unsqueeze(-2), dt).squeeze(-2), moved)

    def _update(
        self, state: GaussianState, y: Tensor, observed: Tensor, generator: Generators
    ) -> tuple[GaussianState, Tensor]:
        """K = Sigma H' S^-1, mu = mu + K (y - h(mu)), Sigma = (I - K H) Sigma (I - K H)' + K R K'."""
        measured = observed.reshape(-1, self.n_dofs).any(0)
        mean, covariance = state
        if not bool(measured.any()):
            return state, mean.new_zeros(observed.shape[:-1])
        rows = None if bool(measured.all()) else measured.nonzero().squeeze(-1)
        y, deviation = self._rows(y, rows), self._rows(self._deviation(mean[..., 0]), rows)
        observed = self._rows(observed, rows)
        by_jacobian = self._jacobian(mean, rows, observed)
        cross = by_jacobian(covariance)  # Sigma H', [..., n, D]
        innovation = by_jacobian(cross.transpose(-1, -2))
        innovation = 0.5 * (innovation + innovation.transpose(-1, -2))
        values = torch.where(observed, y, 0)
        predicted = torch.where(observed, self._rows(self.project(state), rows), 0)
        if self.noise.robust is not None:
            spread = innovation.diagonal(dim1=-2, dim2=-1)
            values, deviation, _ = self.noise.robust(values, predicted, spread, deviation, self.thinning)
        R = torch.where(observed, deviation.square(), 0)
        S = innovation + torch.diag_embed(torch.where(observed, R, 1))
        scale = S.diagonal(dim1=-2, dim2=-1).sqrt()
        try:
            factor = cholesky(S / (scale.unsqueeze(-1) * scale.unsqueeze(-2)), rows)
        except FactorisationError as error:
            raise self._named(error, None) from error  # its DoFs are numbered as in the filter
        residual = values - predicted
        gain = torch.cholesky_solve(cross.transpose(-1, -2) / scale.unsqueeze(-1), factor) / scale.unsqueeze(-1)
        gain = gain.transpose(-1, -2)
        mean = mean + (gain @ residual.unsqueeze(-1)).squeeze(-1)
        # Joseph's (I - KH) Sigma (I - KH)' + K R K' is Sigma - K B' - B K' with B = Sigma H' - K S / 2: one product.
        half = cross - 0.5 * gain @ (innovation + torch.diag_embed(R))
        pair = torch.cat([gain, half], dim=-1)
        other = torch.cat([half, gain], dim=-1)
        joseph = add_product(covariance, -pair, other.transpose(-1, -2))
        whitened = torch.linalg.solve_triangular(factor, (residual / scale).unsqueeze(-1), upper=False).squeeze(-1)
        log_scale = factor.diagonal(dim1=-2, dim2=-1).log() + scale.log()
        terms = -0.5 * whitened.square() - log_scale - 0.5 * math.log(2 * math.pi)
        return GaussianState(mean, joseph), torch.where(observed, terms, 0).sum(-1)

    def _jacobian(self, mean: Tensor, rows: Tensor | None, observed: Tensor) -> Callable[[Tensor], Tensor]:
        """Product with H', [..., m, n] -> [..., m, D], over some rows of H; those not observed count as 0."""
        basis, phase = self._observation.basis, mean[..., 0]
        slope = basis.project_derivative(phase, mean[..., 2:]).unsqueeze(-2)

        def product(matrix: Tensor) -> Tensor:
            """matrix H'."""
            values = matrix[..., :1] * slope + basis.project_rows(phase, matrix[..., 2:])
            return torch.where(observed.unsqueeze(-2), self._rows(values, rows), 0)

        return product

    @staticmethod
    def _rows(values: Tensor, rows: Tensor | None) -> Tensor:
        return values if rows is None else values[..., rows]

    @property
    def _dynamics(self) -> ConstantVelocityPhase:
        return self.dynamics  # type: ignore[return-value]

    @property
    def _observation(self) -> BasisProjection:
        return self.observation  # type: ignore[return-value]

    @property
    def _process(self) -> InteractionNoise:
        return self.noise.process  # type: ignore[return-value]

    @property
    def _prior(self) -> MomentPrior:
        return self.prior  # type: ignore[return-value]

    @eager
    def project(self, state: GaussianState) -> Tensor:
        """h(mu), [..., D]."""
        return self._observation.basis.project(state.mean[..., 0], state.mean[..., 2:])

    def phase(self, state: GaussianState) -> Tensor:
        """See `Filter.phase`."""
        return state.mean[..., 0]

    @eager
    def forecast(self, state: GaussianState, phase: Phases | None = None) -> Forecast:
        """h(phi, mu) and Phi(phi) Sigma_ww Phi(phi)' at phases to come; see `Filter.forecast`."""
        basis = self._observation.basis
        phase = self._phases_ahead(state) if phase is None else as_phases(phase, state.mean)
        phase = phase.to(state.mean).expand(*state.mean.shape[:-1], phase.shape[-1])
        mean = basis.project(phase, state.mean[..., 2:].unsqueeze(-2))
        # Where the prior is rank deficient rounding can leave less than nothing.
        variance = basis.project_covariance(phase, state.covariance[..., 2:, 2:]).clamp(min=0)
        return Forecast(mean, variance, phase)

    def restrict(self, dofs: Tensor, thinning: int = 1) -> ExtendedFilter:
        """See `Filter.restrict`."""
        model = self._select(dofs, thinning)
        part = ExtendedFilter(
            model.dynamics,
            model.observation,
            model.noise,
            self._prior.select(model.state),
            model.n_dofs,
            model.dt,
            thinning * self.thinning,
            model.dof_names,
        )
        return part.train(self.training)

    def _leaves_span(self) -> str | None:
        return "the prior covariance is shrunk" if self._prior.shrinkage else super()._leaves_span()

    def extra_repr(self) -> str:
        """The options that are not modules."""
        return f"shrinkage={self._prior.shrinkage}, thinning={self.thinning}"


def bip(
    primitive: InteractionPrimitive,
    *,
    residual_variance: Tensor | None = None,
    weight_noise: float | None = None,
    context: Basis | None = None,
    shrinkage: float = 0.0,
    robust: RobustWeights | None = None,
) -> ExtendedFilter:
    """The paper's BIP: a Gaussian prior with the demonstrations' moments and an extended Kalman filter.

    The paper writes Q with ones on the diagonal of the weights. In the units of a robot that would be noise of
    one radian a sample; as in the other filters here, weights have no process noise unless it is asked for.

    Args:
        primitive: of the demonstrations.
        residual_variance, weight_noise, context, robust: see `interaction_model`.
        shrinkage: of the prior covariance towards its diagonal, in [0, 1]; see `MomentPrior`. With fewer
            demonstrations than weights the covariance is rank deficient, in the paper and by default.

    Returns:
        A filter with parameters of its own, in the dtype and on the device of the primitive.
    """
    model = interaction_model(primitive, residual_variance, weight_noise, context, robust)
    prior = MomentPrior(demonstration_states(primitive), shrinkage)
    return ExtendedFilter(
        model.dynamics, model.observation, model.noise, prior, model.n_dofs, model.dt, dof_names=model.dof_names
    )
