"""What a measurement says of an ensemble: the innovation y - HX, its covariance S and the factor of S.

Shapes: ``...`` batch, E members, D observation. A row that was not measured leaves S and the likelihood untouched:
rows that no entry of the batch measured are cut out, the others are masked before the arithmetic, so neither their
values nor their gradients can reach anything.

Products are formed of differences, never of values whose mean cancels in exact arithmetic only: members a metre from
the origin that differ by a tenth of a millimetre keep four digits of that in float32.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.filtering.functional.linear import cholesky
from torch_ebip.filtering.functional.moments import centred, member_shares


class Taper(NamedTuple):
    """Localisation: factors in [0, 1] on covariances, elementwise (a Schur product).

    Attributes:
        state: [n, D], on the cross-covariance of state and observation.
        observation: [D, D], on the covariance of the observations; positive semidefinite, ones on the diagonal.
    """

    state: Tensor
    observation: Tensor

    def __repr__(self) -> str:
        return brief(self)

    def select(self, rows: Tensor | None) -> Taper:
        """The factors of some rows of the observation, int64 [k]; None for all."""
        if rows is None:
            return self
        observation = self.observation.index_select(-2, rows).index_select(-1, rows)
        return Taper(self.state.index_select(-1, rows), observation)


class Innovation(NamedTuple):
    """The innovation of an ensemble over the rows that were measured, in units of its own standard deviation.

    Attributes:
        rows: int64, the columns of the observation that were kept; None for all.
        scale: [..., D], square root of the diagonal of S: what one unit is.
        anomalies: HA, [..., E, D].
        weighted: the same, each row times what its member counts in a covariance.
        residual: y - mean HX, [..., D]; 0 where it was not measured.
        S: innovation covariance, [..., D, D], ones on its diagonal.
        factor: lower Cholesky factor of S.
        noise: rows of the factor of R, [..., D, D_all].
        observed: bool [..., D]; None for all.
    """

    rows: Tensor | None
    scale: Tensor
    anomalies: Tensor
    weighted: Tensor
    residual: Tensor
    S: Tensor
    factor: Tensor
    noise: Tensor
    observed: Tensor | None

    def __repr__(self) -> str:
        return brief(self)


def innovation_of(
    projections: Tensor,
    y: Tensor,
    noise_cholesky: Tensor,
    observed: Tensor | None = None,
    taper: Taper | None = None,
    weights: Tensor | None = None,
) -> Innovation | None:
    """The innovation of a measurement; None if no entry of the batch measured anything.

    Arguments as `ensemble_update`, which checks them.

    Raises:
        FactorisationError: an S that is not positive definite.
    """
    rows = None
    if observed is not None:
        kept = observed.reshape(-1, observed.shape[-1]).any(0)
        if not bool(kept.any()):
            return None
        if not bool(kept.all()):
            rows = kept.nonzero().squeeze(-1)
            projections, y, observed = (part.index_select(-1, rows) for part in (projections, y, observed))
            noise_cholesky = noise_cholesky.index_select(-2, rows)
        if bool(observed.all()):
            observed = None
    anomalies, reference, shift = centred(projections, weights)
    noise = noise_cholesky
    if observed is None:
        residual = (y - reference) - shift
    else:
        anomalies = torch.where(observed.unsqueeze(-2), anomalies, 0)
        noise = torch.where(observed.unsqueeze(-1), noise, 0)
        residual = torch.where(observed, (torch.where(observed, y, 0) - reference) - shift, 0)
    shares = member_shares(projections, weights)
    # In units of its own standard deviation S has ones on its diagonal: modalities whose units differ by
    # many orders of magnitude can be factored together in float32. The result is the same in all units, so they
    # are constants to the gradient, whose way through them would cancel, or overflow where deviations are tiny.
    variance = (anomalies.detach().square() * shares.detach()).sum(-2) + noise.detach().square().sum(-1)
    if observed is not None:
        variance = torch.where(observed, variance, 1)
    scale = torch.where(variance > 0, variance, 1).sqrt()
    anomalies = anomalies / scale.unsqueeze(-2)
    noise = noise / scale.unsqueeze(-1)
    weighted = anomalies * shares
    covariance = weighted.transpose(-1, -2) @ anomalies
    if taper is not None:
        covariance = covariance * taper.select(rows).observation
    S = covariance + noise @ noise.transpose(-1, -2)
    if observed is not None:
        S = S + torch.diag_embed((~observed).to(S))
    return Innovation(rows, scale, anomalies, weighted, residual / scale, S, cholesky(S, rows), noise, observed)


def log_likelihood(innovation: Innovation) -> Tensor:
    """Log of the density N(y; mean HX, S), [...], over what was measured."""
    whitened = torch.linalg.solve_triangular(innovation.factor, innovation.residual.unsqueeze(-1), upper=False)
    log_scale = innovation.factor.diagonal(dim1=-2, dim2=-1).log() + innovation.scale.log()
    terms = -0.5 * whitened.squeeze(-1).square() - log_scale - 0.5 * math.log(2 * math.pi)
    if innovation.observed is not None:
        terms = torch.where(innovation.observed, terms, 0)
    total: Tensor = terms.sum(-1)
    return total
