"""Means and covariances of members [..., E, n], weighted or not."""

from __future__ import annotations

from torch import Tensor


def ensemble_mean(members: Tensor, weights: Tensor | None = None) -> Tensor:
    """Mean [..., n] of members [..., E, n] with weights [..., E] that sum to 1; default: equal ones."""
    return members.mean(-2) if weights is None else (weights.unsqueeze(-2) @ members).squeeze(-2)


def ensemble_variance(members: Tensor, weights: Tensor | None = None, unbiased: bool = True) -> Tensor:
    """Variance [..., n] of members [..., E, n] with weights [..., E]; default: equal ones.

    With ``unbiased`` for members that are draws; without, that of the members as a distribution of their own.
    """
    anomalies = members - ensemble_mean(members, weights).unsqueeze(-2)
    return (anomalies.square() * member_shares(members, weights, unbiased)).sum(-2)


def ensemble_covariance(members: Tensor, weights: Tensor | None = None, unbiased: bool = True) -> Tensor:
    """Covariance [..., n, n] of members [..., E, n] with weights [..., E]; otherwise as `ensemble_variance`."""
    anomalies = members - ensemble_mean(members, weights).unsqueeze(-2)
    return (anomalies * member_shares(members, weights, unbiased)).transpose(-1, -2) @ anomalies


def member_shares(members: Tensor, weights: Tensor | None, unbiased: bool = True) -> Tensor:
    """What each member's squared anomaly counts in a covariance, [..., E, 1] or [1]."""
    if weights is None:
        return members.new_tensor([1 / (members.shape[-2] - unbiased)])
    if not unbiased:
        return weights.unsqueeze(-1)
    return (weights / (1 - weights.square().sum(-1, keepdim=True))).unsqueeze(-1)
