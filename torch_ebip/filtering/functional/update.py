"""The ensemble Kalman update as pure functions: no state, no randomness of their own, leading batch dimensions.

Stochastic update: the paper's Section IV (equations for S_t, K_t and X_{t|t}), with the perturbed observations
of Burgers, van Leeuwen & Evensen (1998). Square-root update: Whitaker & Hamill (2002), equation (10), after
Andrews (1968). Members are rows, as everywhere in this package.

An update has two halves. A rule turns the innovation into ``moves``, one row a member, that went through S^-1; the
gain's other half, the cross-covariance of state and observation, takes them to the state (`apply_gain`). K = A' HA
S^-1 / (E - 1) is never formed: n x D numbers nobody needs.

Members may carry weights [..., E] that sum to 1: then means and covariances are weighted, the latter by
w_j / (1 - sum w^2), which is 1 / (E - 1) for equal ones. A caller whose members are deviations from some point
already says so (``centred``), which saves a pass over them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.brief import brief
from torch_ebip.filtering.functional.innovation import Innovation, Taper, innovation_of, log_likelihood
from torch_ebip.filtering.functional.linear import add_product, cholesky


class Spread(NamedTuple):
    """What becomes of anomalies A: ``scale`` * (A + ``keep`` * (A_updated - A)); the updated mean is left alone.

    Attributes:
        scale: [...], or None for 1: inflation.
        keep: [...], or None for 1: share of the change that is kept (1 minus a relaxation to the prior's anomalies).
    """

    scale: Tensor | None = None
    keep: Tensor | None = None

    def __repr__(self) -> str:
        return brief(self)


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

    Example:
        >>> import torch
        >>> from torch_ebip import functional
        >>> draw, R = torch.randn, 0.1 * torch.eye(1)
        >>> X = draw(50, 3)
        >>> X, log_likelihood = functional.ensemble_update(X, X[:, :1], torch.ones(1), R.sqrt(), draw(50, 1))
    """
    _check(members, projections, y, noise_cholesky, observed)
    if perturbations.shape[-2:] != projections.shape[-2:]:
        raise ValueError(
            f"perturbations must be [..., {projections.shape[-2]}, {projections.shape[-1]}] as the projections, "
            f"got {tuple(perturbations.shape)}"
        )
    innovation = innovation_of(projections, y, noise_cholesky, observed, taper, weights)
    if innovation is None:
        return nothing_observed(members, projections, y)
    moves = stochastic_moves(innovation, perturbations)
    updated = apply_gain(moves, members, innovation, taper, weights, Spread(scale=inflation), centred)
    return updated, log_likelihood(innovation)


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

    See `square_root_moves`. Arguments, returns and errors as `ensemble_update`, without perturbations.
    """
    _check(members, projections, y, noise_cholesky, observed)
    innovation = innovation_of(projections, y, noise_cholesky, observed, taper, weights)
    if innovation is None:
        return nothing_observed(members, projections, y)
    moves = square_root_moves(innovation)
    updated = apply_gain(moves, members, innovation, taper, weights, Spread(scale=inflation), centred)
    return updated, log_likelihood(innovation)


def stochastic_moves(innovation: Innovation, perturbations: Tensor) -> Tensor:
    """S^-1 (y + eps - HX), [..., E, D], with standard-normal draws [..., E, D_all] for eps = U draw, U U' = R."""
    noise = perturbations @ innovation.noise.transpose(-1, -2)
    departures = innovation.residual.unsqueeze(-2) + noise - innovation.anomalies
    if innovation.observed is not None:
        departures = departures * innovation.observed.unsqueeze(-2)
    return torch.cholesky_solve(departures.transpose(-1, -2), innovation.factor).transpose(-1, -2)


def square_root_moves(innovation: Innovation) -> Tensor:
    """S^-1 (y - mean HX) for the mean less V^-T (V + U)^-1 HA for each anomaly, [..., E, D]; V V' = S, U U' = R.

    So the anomalies move by -K~ HA, K~ = P H' V^-T (V + U)^-1, which satisfies
    (I - K~ H) P (I - K~ H)' = P - P H' S^-1 H P for any factors; here they are Cholesky factors, so that two
    triangular solves do it and gradients exist even where eigenvalues coincide.
    With a taper the same formulas use the tapered covariances; the identity then holds approximately.
    """
    V = innovation.factor
    R = innovation.noise @ innovation.noise.transpose(-1, -2)
    if innovation.observed is not None:
        R = R + torch.diag_embed((~innovation.observed).to(R))
    U = cholesky(R, innovation.rows)
    shift = torch.cholesky_solve(innovation.residual.unsqueeze(-1), V).transpose(-1, -2)
    shrink = torch.linalg.solve_triangular(V + U, innovation.anomalies.transpose(-1, -2), upper=False)
    shrink = torch.linalg.solve_triangular(V.transpose(-1, -2), shrink, upper=True).transpose(-1, -2)
    moves: Tensor = shift - shrink
    return moves


def apply_gain(
    moves: Tensor,
    members: Tensor,
    innovation: Innovation,
    taper: Taper | None = None,
    weights: Tensor | None = None,
    spread: Spread = Spread(),  # noqa: B008, it is immutable
    centred: bool = False,
) -> Tensor:
    """The new members [..., E, n]: X plus, for each, its move through the cross-covariance (HA)' A / (E - 1).

    Weighted anomalies sum to zero over members, so (HA)' A is (HA)' (X - c) for any c: one of the members, or 0 where
    they are deviations already. With E members, D rows and n states the products cost 4 nED from the left of the
    members, 2 nE^2 + 2 E^2 D by way of an E x E transform; the cheaper is taken.

    With moves L, cross-covariance C and mean m, of the increments LC a share ``keep`` is kept about their mean w'LC,
    and the result is scaled about the new mean m + w'LC:
    X + (s - 1)(X - c) + (s k L + (1 - s k) w'L) C + (1 - s)(m - c).

    Args:
        moves: L of a rule, [..., E, D].
        members: X, [..., E, n].
        innovation, taper, weights, centred: as of the update.
        spread: of the anomalies after the update; an entry of the batch that measured nothing is left as it is.
    """
    E, n = members.shape[-2:]
    D = moves.shape[-1]
    weighted = innovation.weighted.transpose(-1, -2)
    near = members if centred else members - members[..., :1, :].detach()
    scale, keep = (_where_measured(factor, innovation.observed) for factor in spread)
    if taper is None and scale is None and keep is None and 4 * n * D > 2 * n * E + 2 * E * D:
        return add_product(members, moves @ weighted, near)
    if scale is not None or keep is not None:
        shares = members.new_full((E,), 1 / E) if weights is None else weights
        shares = shares.unsqueeze(-2).expand(*members.shape[:-2], 1, E)
        factors = [factor for factor in (scale, keep) if factor is not None]
        kept = (factors[0] if len(factors) == 1 else factors[0] * factors[1])[..., None, None]
        moves = kept * moves + (1 - kept) * (shares @ moves)
    base = members
    if scale is not None:
        growth = scale[..., None, None].expand(*members.shape[:-2], 1, 1)
        moves = torch.cat([moves, (1 - growth).expand(*members.shape[:-2], E, 1)], dim=-1)
        weighted = torch.cat([weighted, shares], dim=-2)
        base = growth * members if centred else members + (growth - 1) * near
    cross_covariance = weighted @ near  # below it the mean, where that is scaled about
    if taper is not None:
        factor = taper.select(innovation.rows).state.transpose(-1, -2)
        tapered = cross_covariance[..., :D, :] * factor
        cross_covariance = torch.cat([tapered, cross_covariance[..., D:, :]], dim=-2)
    return add_product(base, moves, cross_covariance)


def _where_measured(factor: Tensor | None, observed: Tensor | None) -> Tensor | None:
    return factor if factor is None or observed is None else torch.where(observed.any(-1), factor, 1)


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


def nothing_observed(members: Tensor, projections: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """An update that measured nothing: the members [..., E, n] as they are, log-likelihood 0 [...]."""
    return members, torch.zeros_like(projections[..., 0, 0] + torch.where(y.isnan(), 0, y)[..., 0])
