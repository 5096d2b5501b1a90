"""The eBIP pair: constant-velocity phase (the paper's G) and the basis projection (the paper's h).

State: phase, phase velocity, weights.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip.basis.stacked import StackedBasis


class ConstantVelocityPhase(nn.Module):
    """g(x): the phase advances by its velocity times dt, all else stays (the paper's matrix G).

    Outside [0, 1] the paper says nothing. An interaction that is over stays at its end: there the excess e
    becomes e / (1 + |e| / overrun), which is e near the interval and never more than ``overrun``. So members
    that ran past the end while sensors were blind wait close to it, keep their gradients and their response
    to measurements, and can be called back.

    Args:
        overrun: how far beyond the interval a phase can get.
    """

    def __init__(self, overrun: float = 0.05) -> None:
        super().__init__()
        self.overrun = overrun

    def forward(self, members: Tensor, dt: Tensor) -> Tensor:
        """Members [..., E, n] after dt [...] seconds."""
        phase = members[..., :1] + members[..., 1:2] * dt[..., None, None]
        excess = phase - phase.clamp(0, 1)
        phase = phase - excess * excess.abs() / (self.overrun + excess.abs())
        return torch.cat([phase, members[..., 1:]], dim=-1)


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
        return self.basis.project(members[..., 0], members[..., 2:])

    def phase(self, members: Tensor) -> Tensor:
        """Phase [..., E] of each of the members [..., E, n]."""
        return members[..., 0]

    def at(self, members: Tensor, phase: Tensor) -> Tensor:
        """Projections [..., P, E, D] of members [..., E, n] at phases [..., P] that all of them share."""
        at = phase.unsqueeze(-1).expand(*phase.shape, members.shape[-2])
        return self.basis.project(at, members[..., 2:].unsqueeze(-3))
