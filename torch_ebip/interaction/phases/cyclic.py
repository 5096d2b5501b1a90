"""A phase on a circle: an interaction that repeats, as often as people like."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor

from torch_ebip.interaction.phases.constant_velocity import ConstantVelocityPhase


class CyclicPhase(ConstantVelocityPhase):
    """Phase and phase velocity, in cycles and cycles a second; nothing ends at 1.

    Within half a cycle of their mean members stay as they are, so that mean and spread of phases are those of real
    numbers; from one that is further off whole cycles are taken, which mean nothing on a circle, and from all of them
    where the mean has come once round: it lies within 0 and 1.

    Args:
        overrun: of no meaning on a circle; kept so that phases are made alike.

    Example:
        >>> import torch
        >>> from torch_ebip import CyclicPhase
        >>> CyclicPhase()(torch.tensor([[0.75, 0.5, 3.0], [0.5, 0.5, 3.0]]), torch.tensor(1.0)).tolist()
        [[0.25, 0.5, 3.0], [0.0, 0.5, 3.0]]
    """

    periodic: ClassVar[bool] = True

    def hold(self, phase: Tensor) -> Tensor:
        """Phases [..., E] of an ensemble, each within half a cycle of their mean, and that within 0 and 1."""
        middle = phase.detach().mean(-1, keepdim=True)
        phase = phase - (phase.detach() - middle).round()
        return phase - phase.detach().mean(-1, keepdim=True).floor()

    def held_slope(self, phase: Tensor) -> Tensor:
        """See `PhaseModel.held_slope`: 1 at every phase [...]."""
        return torch.ones_like(phase)

    def advancer(self, moving: Tensor) -> Callable[[float | Tensor], None]:
        """See `PhaseModel.advancer`, of members that are columns, moving [..., 2, E]."""
        return super().advancer(moving)

    def moved_covariance(self, mean: Tensor, covariance: Tensor, dt: Tensor) -> Tensor:
        """See `PhaseModel.moved_covariance`: of a mean [..., n] and a covariance [..., n, n], for dt [...] s."""
        return super().moved_covariance(mean, covariance, dt)
