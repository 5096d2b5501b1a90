"""The eBIP pair: constant-velocity phase (the paper's G) and the basis projection (the paper's h).

State: phase, phase velocity, weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_ebip.arguments import as_number
from torch_ebip.basis.stacked import StackedBasis


def split_state(members: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Phase [..., 1], phase velocity [..., 1] and weights [..., n - 2] of states [..., n].

    A split, not three slices: its backward pass is one concatenation instead of three mostly empty tensors.
    """
    phase, velocity, weights = torch.split(members, [1, 1, members.shape[-1] - 2], dim=-1)
    return phase, velocity, weights


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
        self.overrun = as_number("overrun", overrun, 0, above=True)

    def extra_repr(self) -> str:
        """How far a phase can get."""
        return f"overrun={self.overrun:g}"

    def forward(self, members: Tensor, dt: Tensor) -> Tensor:
        """The members [..., E, n] after dt [...] seconds."""
        # A copy with one column exchanged costs a third of putting columns together.
        moved = members.clone()
        moved[..., 0] = self.hold(members[..., 0] + members[..., 1] * dt[..., None])
        return moved

    def hold(self, phase: Tensor) -> Tensor:
        """Phases [...] with what lies beyond the interval drawn in: e becomes e overrun / (overrun + |e|)."""
        inside = phase.clamp(0, 1)
        excess = phase - inside
        return torch.addcdiv(inside, excess, excess.abs() + self.overrun, value=self.overrun)

    def slope(self, mean: Tensor, dt: Tensor) -> Tensor:
        """Derivative [...] of the phase in dt [...] seconds by that of the mean [..., n]: 1 within the interval."""
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
        return self.rows(members, None)

    def rows(self, members: Tensor, dofs: Sequence[int] | None, centre: Tensor | None = None) -> Tensor:
        """Projections [..., E, k] of members [..., E, n], of some dofs (ascending indices; None for all).

        With a centre [..., n] of members that are deviations from it.
        """
        phase, _, weights = split_state(members)
        return self.basis.project(phase.squeeze(-1), weights, dofs, _middle(centre))

    def measure(
        self,
        members: Tensor,
        dofs: Sequence[int] | None,
        others: Tensor | None,
        offsets: Tensor | None,
        centre: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """What an update needs to know of members, in one pass over them.

        Args:
            members: [..., E, n].
            dofs: ascending indices of k DoFs; None for all.
            others: weights [..., E, n_weights] to be projected at the members' phases too; default: none.
            offsets: [O], added to the phases for these; what lies beyond the interval is moved to its ends.
            centre: [..., n], to which the members are deviations; its phase is 0; default: they are none.

        Returns:
            Phases [..., E], projections [..., E, k], and those of the others, [..., E, O, k].
        """
        phase, _, weights = split_state(members)
        paths = None
        if others is not None and offsets is not None:
            paths = self.basis.project_paths((phase + offsets).clamp(0, 1), others, dofs)
        phase = phase.squeeze(-1)
        return phase, self.basis.project(phase, weights, dofs, _middle(centre)), paths

    def phase(self, members: Tensor) -> Tensor:
        """Phase [..., E] of each of the members [..., E, n]."""
        return members[..., 0]

    def at(self, members: Tensor, phase: Tensor) -> Tensor:
        """Projections [..., P, E, D] of members [..., E, n] at points of phase [..., P] that all of them share."""
        return self.basis.project_paths(phase.unsqueeze(-2), members[..., 2:]).transpose(-2, -3)


def _middle(centre: Tensor | None) -> Tensor | None:
    """The weights of a centre [..., n]; None if there is nothing to add, as where no weight lies far from 0."""
    return None if centre is None or not bool(centre.any()) else centre[..., 2:]
