"""The process noise of a step of the live path, kept while neither the step nor a parameter changes."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.common.modules import Versions
from torch_ebip.filtering.carriers.serving import HasFactor


class Step(NamedTuple):
    """A step of so many seconds.

    Attributes:
        seconds: [], s.
        factor: [..., m, m], lower factor of Q.
    """

    seconds: Tensor
    factor: Tensor

    def __repr__(self) -> str:
        return brief(self)


class StepNoise:
    """Q of the steps of a carrier.

    Args:
        noise: of the model.
        like: a tensor [..., m + k, E], for batch dimensions, dtype and device.
    """

    def __init__(self, noise: HasFactor, like: Tensor) -> None:
        self.noise, self._like = noise, like
        self._versions = Versions(noise)  # type: ignore[arg-type]
        self._dt, self._kept = -1.0, Step(like, like)

    def of(self, dt: float) -> Step:
        """The step of dt seconds."""
        if self._versions.changed() or self._dt != dt:
            seconds = self._like.new_tensor(dt)
            factor = self.noise.factor(seconds)
            self._dt, self._kept = dt, Step(seconds, factor.expand(*self._like.shape[:-2], *factor.shape[-2:]))
        return self._kept
