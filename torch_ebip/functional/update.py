"""The ensemble Kalman update as pure functions: no state, no randomness of their own, leading batch dimensions.

Stochastic update: the paper's Section IV (equations for S_t, K_t and X_{t|t}), with the perturbed observations
of Burgers, van Leeuwen & Evensen (1998). Square-root update: Whitaker & Hamill (2002), equation (10), after
Andrews (1968). Members are rows, as everywhere in this package.

Shapes: ``...`` batch, E members, n state, D observation. An unmeasured row leaves S, the gain and the likelihood
untouched: rows that no entry of the batch measured are cut out, the others are masked before the arithmetic, so
neither their values nor their gradients can reach anything.

Members may carry weights [..., E] that sum to 1: then means and covariances are weighted, the latter by
w_j / (1 - sum w^2), which is 1 / (E - 1) for equal ones.

Products are formed of differences, never of values whose mean cancels in exact arithmetic only: members a metre from
the origin that differ by a tenth of a millimetre keep four digits of that in float32. A caller whose members are
deviations already says so (``centred``), which saves a pass over them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.ambient import without_autocast
from torch_ebip.functional.linear import add_product, cholesky
from torch_ebip.functional.moments import centred as taken_apart
from torch_ebip.functional.moments import member_shares


class Taper(NamedTuple):
    """Localisation: factors in [0, 1] on covariances, elementwise (a Schur product).

    Attributes:
        state: [n, D], on the cross-covariance of state and observation.
        observation: [D, D], on the covariance of the observations; positive semidefinite, ones on the diagonal.
    """

    state: Tensor
    observation: Tensor


class _Innovation(NamedTuple):
    """Everything an update needs, over measured rows only and in units of the innovation's deviation."""

    rows: Tensor | None  # int64, the columns that were kept; None for all
    scale: Tensor  # [..., D], square root of the diagonal of S
    anomalies: Tensor  # HA / scale, [..., E, D]
    weighted: Tensor  # the same, each row times its share in a covariance
    residual: Tensor  # (y - mean HX) / scale, [..., D]; 0 where unmeasured
    cholesky: Tensor  # of S in those units, [..., D, D]
    noise: Tensor  # rows of the factor of R in those units, [..., D, D_all]
    observed: Tensor | None  # bool [..., D]; None for all


@without_autocast
def ensemble_update(
    members: Tensor,
    projections: Tensor,
    y: Tensor,
    noise_cholesky: Tensor,
    perturbations: Tensor,
    observed: Tensor | None = None,
    taper: Taper | None = None,
    weights: Tensor | None = None,
    inflation: Tensor | None = None,
    centred: bool = False,
) -> tuple[Tensor, Tensor]:
    """Stochastic ensemble Kalman update, X + K (y + eps - HX).

    Args:
        members: X, [..., E, n], E >= 2.
        projections: HX, [..., E, D].
        y: measurement, [..., D], units of the DoFs; ignored (it may be NaN) where not observed.
        noise_cholesky: lower Cholesky factor of R, [..., D, D].
        perturbations: standard-normal draws, [..., E, D]; scaled inside by the Cholesky factor.
        observed: bool [..., D]; default: everything.
        taper: localisation; default: none.
        weights: of the members, [..., E], summing to 1; default: equal.
        inflation: factor [...] on the deviations from the mean after the update; default: none.
        centred: whether the members lie about 0 already, as deviations from an earlier mean do.

    Returns:
        The updated members [..., E, n] and the log-likelihood [...] of y under N(mean HX, S).

    Raises:
        ValueError: shapes that do not fit, fewer than two members, or an S that cannot be factored
            (`FactorisationError`).
    """
    _check(members, projections, y, noise_cholesky, observed)
    if perturbations.shape[-2:] != projections.shape[-2:]:
        raise ValueError(
            f"perturbations must be [..., {projections.shape[-2]}, {projections.shape[-1]}] as the projections, "
            f"got {tuple(perturbations.shape)}"
        )
    innovation = _innovation(projections, y, noise_cholesky, observed, taper, weights)
    if innovation is None:
        return _nothing_observed(members, projections, y)
    noise = perturbations @ innovation.noise.transpose(-1, -2)
    departures = innovation.residual.unsqueeze(-2) + noise - innovation.anomalies
    if innovation.observed is not None:
        departures = departures * innovation.observed.unsqueeze(-2)
    solved = torch.cholesky_solve(departures.transpose(-1, -2), innovation.cholesky).transpose(-1, -2)
    updated = _through_gain(solved, members, innovation, taper, weights, inflation, centred)
    return updated, _log_likelihood(innovation)


@without_autocast
def square_root_update(
    members: Tensor,
    projections: Tensor,
    y: Tensor,
    noise_cholesky: Tensor,
    observed: Tensor | None = None,
    taper: Taper | None = None,
    weights: Tensor | None = None,
    inflation: Tensor | None = None,
    centred: bool = False,
) -> tuple[Tensor, Tensor]:
    """Deterministic update whose analysis covariance is the Kalman posterior of the ensemble's own covariance.

    The mean moves by K (y - mean HX); the anomalies by A - K~ HA with
    K~ = P H' V^-T (V + U)^-1, V V' = S, U U' = R, which satisfies
    (I - K~ H) P (I - K~ H)' = P - P H' S^-1 H P for any factors; here they are Cholesky factors, so that two
    triangular solves do it and gradients exist even where eigenvalues coincide.
    With a taper the same formulas use the tapered covariances; the identity then holds approximately.

    Arguments, returns and errors as `ensemble_update`, without perturbations.
    """
    _check(members, projections, y, noise_cholesky, observed)
    innovation = _innovation(projections, y, noise_cholesky, observed, taper, weights)
    if innovation is None:
        return _nothing_observed(members, projections, y)
    V = innovation.cholesky
    R = innovation.noise @ innovation.noise.transpose(-1, -2)
    if innovation.observed is not None:
        R = R + torch.diag_embed((~innovation.observed).to(R))
    U = cholesky(R, innovation.rows)
    shift = torch.cholesky_solve(innovation.residual.unsqueeze(-1), V).transpose(-1, -2)
    shrink = torch.linalg.solve_triangular(V + U, innovation.anomalies.transpose(-1, -2), upper=False)
    shrink = torch.linalg.solve_triangular(V.transpose(-1, -2), shrink, upper=True).transpose(-1, -2)
    updated = _through_gain(shift - shrink, members, innovation, taper, weights, inflation, centred)
    return updated, _log_likelihood(innovation)


def _check(members: Tensor, projections: Tensor, y: Tensor, noise_cholesky: Tensor, observed: Tensor | None) -> None:
    E, D = projections.shape[-2:]
    if members.shape[-2] != E or E < 2:
        raise ValueError(
            f"members {tuple(members.shape)} and projections {tuple(projections.shape)} must have the same "
            "number of members, at least 2"
        )
    if y.shape[-1:] != (D,):
        raise ValueError(f"y must end in {D}, one value a DoF, got {tuple(y.shape)}")
    if noise_cholesky.shape[-2:] != (D, D):
        raise ValueError(f"noise_cholesky must end in [{D}, {D}], got {tuple(noise_cholesky.shape)}")
    if observed is not None and (observed.shape[-1:] != (D,) or observed.dtype != torch.bool):
        raise ValueError(f"observed must be bool and end in {D}, got {observed.dtype} {tuple(observed.shape)}")


def _innovation(
    projections: Tensor,
    y: Tensor,
    noise_cholesky: Tensor,
    observed: Tensor | None,
    taper: Taper | None,
    weights: Tensor | None,
) -> _Innovation | None:
    """Whitened innovation statistics over the measured rows; None if no entry of the batch measured any."""
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
    anomalies, reference, shift = taken_apart(projections, weights)
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
        factor = taper.observation
        if rows is not None:
            factor = factor.index_select(-2, rows).index_select(-1, rows)
        covariance = covariance * factor
    S = covariance + noise @ noise.transpose(-1, -2)
    if observed is not None:
        S = S + torch.diag_embed((~observed).to(S))
    return _Innovation(rows, scale, anomalies, weighted, residual / scale, cholesky(S, rows), noise, observed)


def _through_gain(
    solved: Tensor,
    members: Tensor,
    innovation: _Innovation,
    taper: Taper | None,
    weights: Tensor | None,
    inflation: Tensor | None,
    centred: bool,
) -> Tensor:
    """Members [..., E, n] after rows [..., E, D], that already went through S^-1, times (HA)' A / (E - 1).

    Weighted anomalies sum to zero over members, so (HA)' A is (HA)' (X - c) for any c: one of the members, or 0 where
    they are deviations already. With E members, D rows and n states the products cost 4 nED from the left of the
    members, 2 nE^2 + 2 E^2 D by way of an E x E transform; the cheaper is taken.

    With increments L C and mean m, inflation by g turns X + L C into
    X + (g - 1)(X - c) + (g L + (1 - g) w'L) C + (1 - g)(m - c).
    """
    E, n = members.shape[-2:]
    D = solved.shape[-1]
    weighted = innovation.weighted.transpose(-1, -2)
    near = members if centred else members - members[..., :1, :].detach()
    if taper is None and inflation is None and 4 * n * D > 2 * n * E + 2 * E * D:
        return add_product(members, solved @ weighted, near)
    if inflation is not None:
        if innovation.observed is not None:  # an entry that measured nothing is left as it is
            inflation = torch.where(innovation.observed.any(-1), inflation, 1)
        growth = inflation[..., None, None].expand(*members.shape[:-2], 1, 1)
        shares = members.new_full((E,), 1 / E) if weights is None else weights
        shares = shares.unsqueeze(-2).expand(*members.shape[:-2], 1, E)
        solved = growth * solved + (1 - growth) * (shares @ solved)
        solved = torch.cat([solved, (1 - growth).expand(*members.shape[:-2], E, 1)], dim=-1)
        weighted = torch.cat([weighted, shares], dim=-2)
    cross = weighted @ near
    if taper is not None:
        factor = taper.state.transpose(-1, -2)
        factor = factor if innovation.rows is None else factor.index_select(-2, innovation.rows)
        cross = torch.cat([cross[..., :D, :] * factor, cross[..., D:, :]], dim=-2)
    if inflation is None:
        return add_product(members, solved, cross)
    return add_product(growth * members if centred else members + (growth - 1) * near, solved, cross)


def _log_likelihood(innovation: _Innovation) -> Tensor:
    whitened = torch.linalg.solve_triangular(
        innovation.cholesky, innovation.residual.unsqueeze(-1), upper=False
    ).squeeze(-1)
    log_scale = innovation.cholesky.diagonal(dim1=-2, dim2=-1).log() + innovation.scale.log()
    terms = -0.5 * whitened.square() - log_scale - 0.5 * math.log(2 * math.pi)
    if innovation.observed is not None:
        terms = torch.where(innovation.observed, terms, 0)
    total: Tensor = terms.sum(-1)
    return total


def _nothing_observed(members: Tensor, projections: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    return members, torch.zeros_like(projections[..., 0, 0] + torch.where(y.isnan(), 0, y)[..., 0])
