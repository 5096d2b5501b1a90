"""Process noise Q of an interaction's state: of what moves always, of the weights if asked for."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.common.draws import Generators, standard_normal
from torch_ebip.common.modules import FastTwins, sharing
from torch_ebip.filtering.noise.constraints import Positive
from torch_ebip.filtering.protocols import View
from torch_ebip.recordings.layout import Layout


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

    def cholesky(self, dt: Tensor, steps: int = 1) -> Tensor:
        """Lower factor of Q for steps dt [...] in seconds: [..., 2, 2]; Q in (1, 1/s) units.

        Args:
            dt: [...], seconds.
            steps: for how many samples each one stands: an acceleration that lasts k of them as one would move the
                velocity k times as far (in variance) as k accelerations; this takes that back.
        """
        sigma = self.acceleration.value / math.sqrt(steps)
        phase = 0.5 * dt.square() * sigma
        zero = torch.zeros_like(phase)
        lower = [dt * sigma * self.coupling.value, dt * sigma * self.independent.value]
        return torch.stack([torch.stack([phase, zero], -1), torch.stack(lower, -1)], -2)

    def covariance(self, dt: Tensor) -> Tensor:
        """Q for steps dt [...] in seconds: [..., 2, 2]."""
        factor = self.cholesky(dt)
        return factor @ factor.transpose(-1, -2)

    def named_values(self, layout: Layout) -> dict[str, float]:
        """What TensorBoard shows, whatever the layout: ``Q/phase_acceleration`` (1/s^2) and the factors on it."""
        names = {"acceleration": self.acceleration, "coupling": self.coupling, "independent": self.independent}
        return {f"Q/phase_{name}": float(parameter.value) for name, parameter in names.items()}


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

    def named_values(self, layout: Layout) -> dict[str, float]:
        """What TensorBoard shows of it: ``Q/weights/MODALITY``, the rates (1/sqrt(s))."""
        return {f"Q/weights/{name}": rate for name, rate in zip(layout.names, self.rates.value.tolist(), strict=True)}


class InteractionNoise(FastTwins, nn.Module):
    """Process noise of a state of what moves and of weights.

    Args:
        phase: noise of what moves, with ``cholesky(dt [...], steps)`` -> [..., m, m], such as `PhaseNoise`.
        weights: noise of the others; default none, so that members stay in the span of the demonstrations.
        moving: m.
    """

    twins: ClassVar[dict[str, tuple[str, ...]]] = {
        "forward": ("add_", "factor", "add_covariance_"),
        "add_": ("factor", "add_covariance_"),
    }
    columns: Tensor | None

    def __init__(self, phase: nn.Module, weights: WeightNoise | None = None, moving: int = 2) -> None:
        super().__init__()
        self.phase = phase
        self.weights = weights
        self.leading = moving
        self.stride = 1
        self.register_buffer("columns", None)

    @property
    def moving(self) -> int | None:
        """How many leading entries of a state it stirs; None for all."""
        return self.leading if self.weights is None else None

    @property
    def leaves_span(self) -> str | None:
        """Why members leave the span of the demonstrations, if weights have noise."""
        return None if self.weights is None else "weights have process noise"

    def select(self, view: View) -> InteractionNoise:
        """The same noise, with the same parameters, for a view of the model."""
        part = sharing(self)
        part.stride = self.stride * view.stride
        columns = view.state[self.leading :] - self.leading
        part.register_buffer("columns", columns if self.columns is None else self.columns[columns])
        return part

    def factor(self, dt: Tensor) -> Tensor:
        """Lower factor [..., m, m] of the covariance of what moves for steps dt [...] seconds."""
        return self._factor(dt)

    def _factor(self, dt: Tensor) -> Tensor:
        return self.phase.cholesky(dt, self.stride)  # type: ignore[operator, no-any-return]

    def covariance(self, dt: Tensor) -> tuple[Tensor, Tensor | None]:
        """Q for steps dt [...] seconds, which has two blocks.

        Returns:
            The covariance of what moves, [..., m, m], and the variances of the other entries, [..., n_weights]; None
            where they have no noise.
        """
        factor, weights = self._factor(dt), self._weight_scale(dt)
        return factor @ factor.transpose(-1, -2), None if weights is None else weights.square()

    def add_covariance_(self, covariance: Tensor, dt: Tensor) -> Tensor:
        """A covariance [..., n, n] of states plus Q for dt [...] seconds, in place."""
        moving, weights = self.covariance(dt)
        covariance[..., : self.leading, : self.leading] += moving
        if weights is not None:
            covariance[..., self.leading :, self.leading :].diagonal(dim1=-2, dim2=-1).add_(weights)
        return covariance

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
        return self._add(members.clone(), dt, generator)

    def add_(self, members: Tensor, dt: Tensor, generator: Generators = None) -> Tensor:
        """The same in place, for members that nobody else holds: see `InteractionNoise.forward`."""
        return self._add(members, dt, generator)

    def _add(self, members: Tensor, dt: Tensor, generator: Generators) -> Tensor:
        m = self.leading
        factor = self._factor(dt).transpose(-1, -2)
        members[..., :m] += standard_normal(members[..., :m].shape, members, generator) @ factor
        scale = self._weight_scale(dt)
        if scale is not None:
            draws = standard_normal(members[..., m:].shape, members, generator)
            members[..., m:] += draws * scale.unsqueeze(-2)
        return members

    def extra_repr(self) -> str:
        """How many steps each one stands for."""
        return f"stride={self.stride}"

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: nothing beside themselves."""
        return ""
