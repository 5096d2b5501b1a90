"""What a filter expects: a mean and a variance, and the members behind them where there are any."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from torch_ebip.common.ambient import outside_inference
from torch_ebip.common.arguments import as_values
from torch_ebip.common.brief import brief
from torch_ebip.filtering.functional import scores

Phases: TypeAlias = Tensor | Sequence[float] | float
"""Of a forecast."""


def as_phases(phase: Phases, like: Tensor) -> Tensor:
    """Phases [P] or [..., P] of a forecast, in the dtype and on the device of ``like``; one number is [1].

    Raises:
        ValueError: NaN or infinity, or no numbers at all.
    """
    if not isinstance(phase, Tensor):
        phase = as_values("phase", phase, None, like)
    phase = outside_inference(phase.to(like))
    if not bool(phase.isfinite().all()):
        raise ValueError("phases must be finite numbers, got NaN or infinity")
    return phase.reshape(1) if phase.ndim == 0 else phase


def as_seconds_ahead(ahead: Phases, like: Tensor) -> Tensor:
    """Seconds [P] of a forecast, infinity allowed, in the dtype and on the device of ``like``; one number is [1].

    Raises:
        ValueError: NaN or negative numbers, more than one dimension.
    """
    seconds = ahead if isinstance(ahead, Tensor) else as_values("ahead", ahead, None, like)
    seconds = outside_inference(seconds.to(like))
    seconds = seconds.reshape(1) if seconds.ndim == 0 else seconds
    if seconds.ndim != 1 or not bool((seconds >= 0).all()):
        raise ValueError(f"ahead must be seconds [P], 0 or more, got {seconds.tolist()}")
    return seconds


class Forecast(NamedTuple):
    """What the filter expects at some phases.

    Attributes:
        mean: [..., P, D], units of the DoFs.
        variance: [..., P, D], of the filter's belief about the noise-free trajectory; squared units.
        phase: [..., P].
        members: [..., P, E, D], trajectories that make up the belief; None for a Gaussian one.
        weights: of the members, [..., P, E], summing to 1; None where all count alike.
        fair: whether the members are draws of equal standing, for whose finite number scores are corrected;
            not so for particles, which are a distribution of their own.
        labels: probability [...] of each of the labelled interactions that may be going on, by name; None: nobody
            asked.
    """

    mean: Tensor
    variance: Tensor
    phase: Tensor
    members: Tensor | None = None
    weights: Tensor | None = None
    fair: bool = True
    labels: Mapping[str, Tensor] | None = None

    def __repr__(self) -> str:
        return brief(self)

    def select(self, dofs: Tensor) -> Forecast:
        """The forecast of some DoFs: bool [D] or indices int64 [k]."""
        members = None if self.members is None else self.members[..., dofs]
        return self._replace(mean=self.mean[..., dofs], variance=self.variance[..., dofs], members=members)

    def at(self, index: int) -> Forecast:
        """The forecast of one of the P phases: without that dimension."""
        return self._replace(
            mean=self.mean[..., index, :],
            variance=self.variance[..., index, :],
            phase=self.phase[..., index],
            members=None if self.members is None else self.members[..., index, :, :],
            weights=None if self.weights is None else self.weights[..., index, :],
        )

    def crps(self, target: Tensor) -> Tensor:
        """Continuous ranked probability score of each DoF.

        Args:
            target: [..., P, D], units of the DoFs.

        Returns:
            [..., P, D], units of the DoFs; smaller is better.
        """
        if self.members is None:
            return scores.gaussian_crps(self.mean, self.variance, target)
        return scores.crps(self.members, target, self.weights, self.fair)

    def probability_below(self, target: Tensor) -> Tensor:
        """Predicted probability of a value below the target, a member that equals it counting half.

        Uniform over many forecasts if they are calibrated (the probability integral transform).

        Args:
            target: [..., P, D], units of the DoFs.

        Returns:
            [..., P, D] in [0, 1].
        """
        if self.members is None:
            deviation = self.variance.clamp(min=torch.finfo(self.variance.dtype).tiny).sqrt()
            below: Tensor = torch.special.ndtr((target - self.mean) / deviation)
            return below
        target = target.unsqueeze(-2)
        shares = (self.members < target).to(target) + 0.5 * (self.members == target).to(target)
        return shares.mean(-2) if self.weights is None else (shares * self.weights.unsqueeze(-1)).sum(-2)
