"""The paper's phase: it advances at a velocity of its own (the matrix G)."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.interaction.noise import PhaseNoise
from torch_ebip.interaction.phases.phase import PhaseModel
from torch_ebip.interaction.primitive import InteractionPrimitive


class ConstantVelocityPhase(PhaseModel):
    """Phase and phase velocity: the phase advances by its velocity times dt, all else stays.

    Args:
        overrun: how far beyond the interval a phase can get, see `PhaseModel`.

    Example:
        >>> import torch
        >>> from torch_ebip import ConstantVelocityPhase
        >>> ConstantVelocityPhase()(torch.tensor([[0.25, 0.5, 3.0]]), torch.tensor(1.0)).tolist()
        [[0.75, 0.5, 3.0]]
    """

    @property
    def moving(self) -> int:
        """Phase and phase velocity."""
        return 2

    def velocity(self, moving: Tensor) -> Tensor:
        """Phase velocity [...], 1/s, of what moves [..., 2]."""
        return moving.select(-1, 1)

    def first(self, primitive: InteractionPrimitive) -> Tensor:
        """First phase and phase velocity of each demonstration, [N, 2]."""
        return torch.stack([primitive.first_phase, primitive.phase_velocity], dim=-1)

    def noise(self, primitive: InteractionPrimitive) -> PhaseNoise:
        """White accelerations that over one interaction add a tenth of the demonstrations' spread of velocities.

        The paper leaves Q open. White accelerations over steps dt move the velocity by sigma sqrt(dt T) in T
        seconds; that is set to 0.1 of the standard deviation of the phase velocities (at least 1 % of their mean).
        """
        velocity = primitive.phase_velocity
        spread = torch.maximum(velocity.std(), 0.01 * velocity.mean())
        return PhaseNoise(0.1 * spread * (primitive.rate * velocity.mean()).sqrt())

    def transition(self, dt: Tensor) -> Tensor:
        """See `PhaseModel.transition`: the paper's G, [..., 2, 2], for dt [...]."""
        one = torch.ones_like(dt)
        return torch.stack([torch.stack([one, dt], -1), torch.stack([torch.zeros_like(dt), one], -1)], -2)
