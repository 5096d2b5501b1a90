"""Process noise Q of the eBIP state: of the phase always, of the weights if asked for."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torch_ebip.ambient import owned
from torch_ebip.draws import Generators, standard_normal
from torch_ebip.noise.constraints import Positive


class NoProcessNoise(nn.Module):
    """Q = 0, for dynamics that bring their own noise or need none."""

    def forward(self, members: Tensor, dt: Tensor, generator: Generators = None) -> Tensor:
        """The members [..., E, n] as they are, whatever dt, in seconds, and generator."""
        return members


class PhaseNoise(nn.Module):
    """A full 2 x 2 covariance of phase and phase velocity, from the piecewise-white acceleration model.

    A constant acceleration of standard deviation sigma over each step moves (phase, velocity) by
    (dt^2 / 2, dt) times it (Bar-Shalom, Li & Kirubarajan 2001, section 6.3.2). That matrix has rank one; the
    factor here is diag(dt^2 / 2, dt) [[1, 0], [coupling, independent]] sigma, positive definite, with all
    three numbers learned. They start at sigma, 1 and 0.01, the model to 1 part in 10^4.

    Args:
        acceleration: scalar, sigma at the start, 1/s^2.
    """

    def __init__(self, acceleration: Tensor) -> None:
        super().__init__()
        self.acceleration = Positive(acceleration)
        self.coupling = Positive(torch.ones_like(acceleration))
        self.independent = Positive(torch.full_like(acceleration, 0.01))

    def cholesky(self, dt: Tensor) -> Tensor:
        """Lower factor of Q for steps dt [...] in seconds: [..., 2, 2]; Q in (1, 1/s) units."""
        sigma = self.acceleration.value
        phase = 0.5 * dt.square() * sigma
        zero = torch.zeros_like(phase)
        lower = [dt * sigma * self.coupling.value, dt * sigma * self.independent.value]
        return torch.stack([torch.stack([phase, zero], -1), torch.stack(lower, -1)], -2)

    def covariance(self, dt: Tensor) -> Tensor:
        """Q for steps dt [...] in seconds: [..., 2, 2]."""
        factor = self.cholesky(dt)
        return factor @ factor.transpose(-1, -2)


class WeightNoise(nn.Module):
    """A random walk of the weights, one learned rate a modality.

    Over dt seconds a weight moves by rate * sqrt(dt) times its own standard deviation over the demonstrations.

    Args:
        rates: [M], 1/sqrt(s), one a modality.
        deviation: [n_weights], standard deviation of each weight over the demonstrations.
        modality_of_weight: int64 [n_weights].
    """

    deviation: Tensor
    modality_of_weight: Tensor

    def __init__(self, rates: Tensor, deviation: Tensor, modality_of_weight: Tensor) -> None:
        super().__init__()
        self.rates = Positive(rates)
        self.register_buffer("deviation", owned(deviation))
        self.register_buffer("modality_of_weight", owned(modality_of_weight))

    def scale(self, dt: Tensor) -> Tensor:
        """Standard deviation of the step of each weight, [..., n_weights] for dt [...] seconds."""
        rate = self.rates.value[self.modality_of_weight] * self.deviation
        return rate * dt.sqrt().unsqueeze(-1)


class InteractionNoise(nn.Module):
    """Process noise of a state (phase, phase velocity, weights).

    White accelerations that last k steps of dt as one would move the velocity k times as far (in variance) as k
    of them; ``thinning`` takes that back, so that a step that stands for k has the noise of k steps.

    Args:
        phase: noise of the first two entries.
        weights: noise of the others; default none, so that members stay in the span of the demonstrations.
        columns: int64 [k], which entries of ``weights`` the state holds; default all of them.
        thinning: how many steps each one stands for.
    """

    columns: Tensor | None

    def __init__(
        self,
        phase: PhaseNoise,
        weights: WeightNoise | None = None,
        columns: Tensor | None = None,
        thinning: int = 1,
    ) -> None:
        super().__init__()
        self.thinning = thinning
        self.phase = phase
        self.weights = weights
        self.register_buffer("columns", None if columns is None else owned(columns))

    def select(self, columns: Tensor, thinning: int = 1) -> InteractionNoise:
        """The same noise, with the same parameters, for a state with some of the weights.

        Args:
            columns: int64 [k], which of them.
            thinning: how many steps each one stands for, on top of the present ones.
        """
        columns = columns if self.columns is None else self.columns[columns]
        return InteractionNoise(self.phase, self.weights, columns, thinning * self.thinning)

    def covariance(self, dt: Tensor) -> tuple[Tensor, Tensor | None]:
        """Q for steps dt [...] seconds, which has two blocks.

        Returns:
            The covariance of phase and phase velocity, [..., 2, 2], and the variances of the other entries,
            [..., n_weights]; None where they have no noise.
        """
        weights = self._weight_scale(dt)
        return self.phase.covariance(dt) / self.thinning, None if weights is None else weights.square()

    def phase_factor(self, dt: Tensor) -> Tensor:
        """Lower factor [..., 2, 2] of the covariance of phase and phase velocity for steps dt [...] seconds."""
        return self.phase.cholesky(dt) / math.sqrt(self.thinning)

    def _weight_scale(self, dt: Tensor) -> Tensor | None:
        if self.weights is None:
            return None
        scale = self.weights.scale(dt)
        return scale if self.columns is None else scale[..., self.columns]

    def forward(self, members: Tensor, dt: Tensor, generator: Generators = None) -> Tensor:
        """The members with noise added.

        Args:
            members: [..., E, n].
            dt: [...], seconds of the step.
            generator: of the draws.

        Returns:
            [..., E, n].
        """
        return self.add_(members.clone(), dt, generator)

    def add_(self, members: Tensor, dt: Tensor, generator: Generators = None) -> Tensor:
        """The same in place, for members that nobody else holds: see `InteractionNoise.forward`."""
        factor = self.phase_factor(dt).transpose(-1, -2)
        members[..., :2] += standard_normal(members[..., :2].shape, members, generator) @ factor
        scale = self._weight_scale(dt)
        if scale is not None:
            draws = standard_normal(members[..., 2:].shape, members, generator)
            members[..., 2:] += draws * scale.unsqueeze(-2)
        return members
