"""Parameters that stay in their set, and that start where they are told to.

Each holds an unconstrained ``raw`` parameter that is zero at the start, so that its size is the distance
travelled: a pull towards the starting point is a penalty on ``raw``, alike for all of them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned


class Constrained(nn.Module, ABC):
    """A learnable value with a starting point and a constraint.

    Args:
        start: the value at the beginning, [...], inside the constraint.

    Attributes:
        raw: the parameter that is optimised; zeros at the start.
        start: buffer, what `value` is when ``raw`` is zero.
    """

    raw: nn.Parameter
    start: Tensor

    def __init__(self, start: Tensor) -> None:
        super().__init__()
        self._check(start)
        self.register_buffer("start", owned(start))
        self.raw = nn.Parameter(owned(torch.zeros_like(start)))

    @staticmethod
    @abstractmethod
    def _check(start: Tensor) -> None:
        """Raise ValueError if the starting point is not inside."""

    @property
    @abstractmethod
    def value(self) -> Tensor:
        """The constrained value [...], shape of `start`."""


class Positive(Constrained):
    """A positive scale: start * (floor + (1 - floor) exp(raw)), never below ``floor`` times the start.

    Args:
        start: positive values, [...].
        floor: smallest fraction of the start.
    """

    def __init__(self, start: Tensor, floor: float = 1e-6) -> None:
        super().__init__(start)
        self.floor = floor

    def extra_repr(self) -> str:
        """Shape and floor."""
        return f"{list(self.start.shape)}, floor={self.floor:g}"

    @staticmethod
    def _check(start: Tensor) -> None:
        if not bool(((start > 0) & start.isfinite()).all()):
            raise ValueError(f"a positive parameter must start above 0, got {start.min():.3g}")

    @property
    def value(self) -> Tensor:
        """Positive values [...], shape of `start`."""
        return self.start * self._factor

    @property
    def root(self) -> Tensor:
        """Square root [...] of the value; so that the gradient passes no square of a unit, which may be tiny."""
        return self.start.sqrt() * self._factor.sqrt()

    @property
    def _factor(self) -> Tensor:
        return self.floor + (1 - self.floor) * self.raw.exp()


class Signed(Constrained):
    """A number of either sign: start + raw."""

    @staticmethod
    def _check(start: Tensor) -> None:
        if not bool(start.isfinite().all()):
            raise ValueError(f"a parameter must start at a finite number, got {start}")

    @property
    def value(self) -> Tensor:
        """Values [...], shape of `start`."""
        return self.start + self.raw


class AboveOne(Constrained):
    """A factor above 1, such as an inflation: 1 + (start - 1) exp(raw)."""

    @staticmethod
    def _check(start: Tensor) -> None:
        if not bool(((start > 1) & start.isfinite()).all()):
            raise ValueError(f"an inflation that is learned must start above 1, got {start}")

    @property
    def value(self) -> Tensor:
        """Factors above 1, [...], shape of `start`."""
        return 1 + (self.start - 1) * self.raw.exp()
