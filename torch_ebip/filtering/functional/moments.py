"""Means and covariances of members [..., E, n], weighted or not.

Sums are formed of differences from one of the members: where values lie far from 0 compared with how they differ, a
sum of the values themselves loses the differences, and weights that sum to 1 but for rounding scale the distance.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.brief import brief


class Centred(NamedTuple):
    """Members taken apart; their mean is ``reference + shift``.

    Attributes:
        anomalies: [..., E, n], what is left of each when the mean is taken out.
        reference: [..., n], one of them.
        shift: [..., n], from it to the mean.
    """

    anomalies: Tensor
    reference: Tensor
    shift: Tensor

    def __repr__(self) -> str:
        return brief(self)


def centred(members: Tensor, weights: Tensor | None = None) -> Centred:
    """Members [..., E, n] and their mean with weights [..., E] that sum to 1; default: equal ones."""
    reference = members[..., :1, :].detach()
    shifted = members - reference
    shift = shifted.mean(-2) if weights is None else (weights.unsqueeze(-2) @ shifted).squeeze(-2)
    return Centred(shifted - shift.unsqueeze(-2), reference.squeeze(-2), shift)


@without_autocast
def ensemble_mean(members: Tensor, weights: Tensor | None = None) -> Tensor:
    """Mean [..., n] of members [..., E, n] with weights [..., E] that sum to 1; default: equal ones."""
    reference = members[..., :1, :].detach()
    shifted = members - reference
    shift = shifted.mean(-2) if weights is None else (weights.unsqueeze(-2) @ shifted).squeeze(-2)
    return reference.squeeze(-2) + shift


@without_autocast
def ensemble_variance(members: Tensor, weights: Tensor | None = None, unbiased: bool = True) -> Tensor:
    """Variance [..., n] of members [..., E, n] with weights [..., E]; default: equal ones.

    With ``unbiased`` for members that are draws; without, that of the members as a distribution of their own.
    """
    anomalies = centred(members, weights).anomalies
    return (anomalies.square() * member_shares(members, weights, unbiased)).sum(-2)


@without_autocast
def ensemble_covariance(members: Tensor, weights: Tensor | None = None, unbiased: bool = True) -> Tensor:
    """Covariance [..., n, n] of members [..., E, n] with weights [..., E]; otherwise as `ensemble_variance`."""
    anomalies = centred(members, weights).anomalies
    return (anomalies * member_shares(members, weights, unbiased)).transpose(-1, -2) @ anomalies


def member_shares(members: Tensor, weights: Tensor | None, unbiased: bool = True) -> Tensor:
    """What each member's squared anomaly counts in a covariance, [..., E, 1] or [1]."""
    if weights is None:
        return members.new_tensor([1 / (members.shape[-2] - unbiased)])
    if not unbiased:
        return weights.unsqueeze(-1)
    return (weights / (1 - weights.square().sum(-1, keepdim=True))).unsqueeze(-1)
