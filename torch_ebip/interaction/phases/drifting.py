"""A phase of order 0: it has no velocity of its own."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip.common.arguments import as_number
from torch_ebip.filtering.noise.constraints import Positive
from torch_ebip.interaction.phases.phase import PhaseModel
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.recordings.layout import Layout


class PhaseWalk(nn.Module):
    """A random walk of the phase: white noise of variance sigma^2 dt in dt seconds, however they are cut into steps.

    Args:
        strength: scalar, sigma at the start, 1/sqrt(s); learned.
    """

    def __init__(self, strength: Tensor) -> None:
        super().__init__()
        self.strength = Positive(strength)

    def cholesky(self, dt: Tensor, steps: int = 1) -> Tensor:
        """Factor of Q for dt [...] in seconds: [..., 1, 1], however many steps each one stands for."""
        return (self.strength.value * dt.sqrt())[..., None, None]

    def named_values(self, layout: Layout) -> dict[str, float]:
        """What TensorBoard shows of it, whatever the layout: ``Q/phase_walk`` (1/sqrt(s))."""
        return {"Q/phase_walk": float(self.strength.value)}


class DriftingPhase(PhaseModel):
    """Phase alone: it drifts at the velocity that all demonstrations share, and walks at random about that.

    A state has one entry less than with `ConstantVelocityPhase`, and how fast a person is cannot be told from how far
    they are. It serves where demonstrations are paced, and where people stop and go: nothing has to be slowed down.

    Args:
        drift: scalar, the velocity at the start, 1/s: as a rule the mean of the demonstrations'; learned.
        overrun: how far beyond the interval a phase can get, see `PhaseModel`.

    Raises:
        ValueError: a drift that is not positive.

    Example:
        >>> import torch
        >>> from torch_ebip import DriftingPhase
        >>> DriftingPhase(0.5)(torch.tensor([[0.25, 3.0]]), torch.tensor(1.0)).tolist()
        [[0.75, 3.0]]
    """

    def __init__(self, drift: float | Tensor, overrun: float = 0.05) -> None:
        super().__init__(overrun)
        self.drift = Positive(torch.tensor(as_number("drift", drift, 0, above=True), device="cpu"))

    @property
    def moving(self) -> int:
        """The phase."""
        return 1

    def velocity(self, moving: Tensor) -> Tensor:
        """The drift [...], 1/s, whatever it is that moves, [..., 1]."""
        return self.drift.value.expand(moving.shape[:-1])

    def first(self, primitive: InteractionPrimitive) -> Tensor:
        """The first phase of each demonstration of a primitive, [N, 1]."""
        return primitive.first_phase.unsqueeze(-1)

    def noise(self, primitive: InteractionPrimitive) -> PhaseWalk:
        """A walk that over one interaction spreads phases as far as the demonstrations' velocities do."""
        velocity = primitive.phase_velocity
        spread = torch.maximum(velocity.std(), 0.01 * velocity.mean())
        return PhaseWalk(spread / velocity.mean().sqrt())

    def transition(self, dt: Tensor) -> Tensor:
        """See `PhaseModel.transition`: 1, [..., 1, 1], for dt [...]."""
        return torch.ones_like(dt)[..., None, None]
