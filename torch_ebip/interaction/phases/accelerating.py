"""A phase of order 2: its velocity changes by an acceleration of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor, nn

from torch_ebip.filtering.noise.constraints import Positive
from torch_ebip.interaction.phases.phase import PhaseModel
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.recordings.layout import Layout

FACTOR = ((20**-0.5, 0.0, 0.0), (5**0.5 / 4, 48**-0.5, 0.0), (5**0.5 / 3, 3**-0.5, 1 / 3))
"""Lower factor of the covariance that white jerk of unit strength adds to (phase, velocity, acceleration) in 1 s."""


class PhaseJerk(nn.Module):
    """White jerk of phase: the integral over a step, so that it does not matter how time is cut into steps.

    Q = sigma^2 [[t^5/20, t^4/8, t^3/6], [., t^3/3, t^2/2], [., ., t]] (Bar-Shalom, Li & Kirubarajan 2001, section
    6.2.3).

    Args:
        strength: scalar, sigma at the start, s^-2.5; learned.
    """

    def __init__(self, strength: Tensor) -> None:
        super().__init__()
        self.strength = Positive(strength)

    def cholesky(self, dt: Tensor, steps: int = 1) -> Tensor:
        """Lower factor of Q for dt [...] in seconds: [..., 3, 3], however many steps each one stands for."""
        powers = torch.stack([dt.pow(2.5), dt.pow(1.5), dt.sqrt()], -1)
        factor: Tensor = self.strength.value * powers.unsqueeze(-1) * dt.new_tensor(FACTOR)
        return factor

    def named_values(self, layout: Layout) -> dict[str, float]:
        """What TensorBoard shows of it, whatever the layout: ``Q/phase_jerk`` (s^-2.5)."""
        return {"Q/phase_jerk": float(self.strength.value)}


class AcceleratingPhase(PhaseModel):
    """Phase, phase velocity and phase acceleration: x' = G x with the Taylor polynomial of second order.

    It serves where a movement's pace changes smoothly within an interaction. Far ahead it goes on at the velocity of
    now: an acceleration that was seen for half a second says nothing of the next two.

    Args:
        overrun: how far beyond the interval a phase can get, see `PhaseModel`.

    Example:
        >>> import torch
        >>> from torch_ebip import AcceleratingPhase
        >>> AcceleratingPhase()(torch.tensor([[0.25, 0.5, 0.25, 3.0]]), torch.tensor(1.0)).tolist()
        [[0.875, 0.75, 0.25, 3.0]]
    """

    makes_new_members: ClassVar[bool] = True

    @property
    def moving(self) -> int:
        """Phase, phase velocity and phase acceleration."""
        return 3

    def velocity(self, moving: Tensor) -> Tensor:
        """Phase velocity [...], 1/s, of what moves [..., 3]."""
        return moving.select(-1, 1)

    def first(self, primitive: InteractionPrimitive) -> Tensor:
        """First phase and phase velocity of each demonstration, no acceleration: [N, 3]."""
        velocity = primitive.phase_velocity
        return torch.stack([primitive.first_phase, velocity, torch.zeros_like(velocity)], dim=-1)

    def noise(self, primitive: InteractionPrimitive) -> PhaseJerk:
        """White jerk that over one interaction adds a tenth of the demonstrations' spread of velocities.

        In T seconds it adds a variance of sigma^2 T^3 / 3 to the velocity; see `ConstantVelocityPhase.noise`.
        """
        velocity = primitive.phase_velocity
        spread = torch.maximum(velocity.std(), 0.01 * velocity.mean())
        return PhaseJerk(0.1 * spread * 3**0.5 * velocity.mean().pow(1.5))

    def transition(self, dt: Tensor) -> Tensor:
        """See `PhaseModel.transition`: [..., 3, 3], for dt [...]."""
        one, zero = torch.ones_like(dt), torch.zeros_like(dt)
        rows = ((one, dt, 0.5 * dt.square()), (zero, one, dt), (zero, zero, one))
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def forward(self, members: Tensor, dt: Tensor) -> Tensor:
        """The members [..., E, n] after dt [...] seconds."""
        moved, dt = members.clone(), dt.unsqueeze(-1)
        phase, velocity, acceleration = members[..., :3].unbind(-1)
        moved[..., 0] = self.hold(phase + dt * (velocity + 0.5 * dt * acceleration))
        moved[..., 1] = velocity + dt * acceleration
        return moved

    def advancer(self, moving: Tensor) -> Callable[[float | Tensor], None]:
        """See `PhaseModel.advancer`, of members that are columns, moving [..., 3, E]."""
        return _Accelerate(self, moving)

    def moved_covariance(self, mean: Tensor, covariance: Tensor, dt: Tensor) -> Tensor:
        """See `PhaseModel.moved_covariance`: of a mean [..., n] and a covariance [..., n, n], for dt [...] s."""
        return super().moved_covariance(mean, covariance, dt)

    def slope(self, mean: Tensor, dt: Tensor) -> Tensor:
        """See `PhaseModel.slope`, at a mean [..., n] for dt [...] s."""
        phase = mean[..., 0] + dt * (mean[..., 1] + 0.5 * dt * mean[..., 2])
        return self.held_slope(phase)


class _Accelerate:
    """Advances members that are columns, [..., 3, E]. An object, so that copies of it advance copies of them."""

    def __init__(self, model: AcceleratingPhase, moving: Tensor) -> None:
        self._model = model
        self._phase, self._velocity, self._acceleration = moving.unbind(-2)

    def __call__(self, dt: float | Tensor) -> None:
        """Advance by dt seconds, one number or [...]."""
        if isinstance(dt, Tensor):
            dt = dt.unsqueeze(-1)
        self._phase += dt * (self._velocity + 0.5 * dt * self._acceleration)
        self._velocity += dt * self._acceleration
        low, high = torch.aminmax(self._phase)
        if float(low) < 0 or float(high) > 1:
            self._phase.copy_(self._model.hold(self._phase))
