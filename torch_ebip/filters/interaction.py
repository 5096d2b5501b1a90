"""The eBIP pair: constant-velocity phase (the paper's G) and the basis projection (the paper's h).

State: phase, phase velocity, weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_ebip.basis.stacked import StackedBasis


class ConstantVelocityPhase(nn.Module):
    """g(x): the phase advances by its velocity times dt, all else stays (the paper's matrix G).

    Outside [0, 1] the paper says nothing. An interaction that is over stays at its end: there the excess e
    becomes e / (1 + |e| / overrun), which is e near the interval and never more than ``overrun``. So members
    that ran past the end while sensors were blind wait close to it, keep their gradients and their response
    to measurements, and can be called back. This acts once in each prediction, so where exactly they wait
    depends a little on the rate of predictions.

    Args:
        overrun: how far beyond the interval a phase can get.
    """

    def __init__(self, overrun: float = 0.05) -> None:
        super().__init__()
        self.overrun = overrun

    def forward(self, members: Tensor, dt: Tensor) -> Tensor:
        """Members [..., E, n] after dt [...] seconds."""
        # One split instead of several slices: its backward pass is one concatenation.
        phase, velocity, weights = members.tensor_split((1, 2), dim=-1)
        phase = phase + velocity * dt[..., None, None]
        excess = phase - phase.clamp(0, 1)
        phase = phase - excess * excess.abs() / (self.overrun + excess.abs())
        return torch.cat([phase, velocity, weights], dim=-1)

    def slope(self, mean: Tensor, dt: Tensor) -> Tensor:
        """Derivative [...] of the next phase by the present one at states [..., n]: 1 within the interval."""
        phase = mean[..., 0] + mean[..., 1] * dt
        excess = (phase - phase.clamp(0, 1)).abs()
        return (1 + excess / self.overrun).pow(-2)


class BasisProjection(nn.Module):
    """h(x): each member's weights through the basis at its own phase.

    Args:
        basis: one basis a DoF.
    """

    def __init__(self, basis: StackedBasis) -> None:
        super().__init__()
        self.basis = basis

    def forward(self, members: Tensor) -> Tensor:
        """Projections [..., E, D] of members [..., E, n]."""
        return self.rows(members, None)[0]

    def rows(self, members: Tensor, dofs: Sequence[int] | None, *others: Tensor) -> list[Tensor]:
        """Projections [..., E, k] of some DoFs (ascending indices; None for all).

        First those of members [..., E, n], then those of ``others``, weights [..., E, n_weights] that take the
        place of the members' own.
        """
        phase, _, weights = members.tensor_split((1, 2), dim=-1)
        return self.basis.project_many(phase.squeeze(-1), [weights, *others], dofs)

    def phase(self, members: Tensor) -> Tensor:
        """Phase [..., E] of each of the members [..., E, n]."""
        return members[..., 0]

    def at(self, members: Tensor, phase: Tensor) -> Tensor:
        """Projections [..., P, E, D] of members [..., E, n] at phases [..., P] that all of them share."""
        at = phase.unsqueeze(-1).expand(*phase.shape, members.shape[-2])
        return self.basis.project(at, members[..., 2:].unsqueeze(-3))
