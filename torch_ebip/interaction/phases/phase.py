"""Phase models: where in an interaction one is, and how that goes on. The paper's is `ConstantVelocityPhase`.

A state of an interaction is what moves, with the phase as its first entry, and the weights, which stand still.
Nothing else in the package knows how many entries move: a phase model of another order is one new file.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor, nn

from torch_ebip.common.arguments import as_number
from torch_ebip.common.modules import FastTwins
from torch_ebip.filtering.protocols import View
from torch_ebip.interaction.primitive import InteractionPrimitive


class PhaseModel(FastTwins, nn.Module, ABC):
    """g of an interaction: it moves the leading entries of a state, the first of which is the phase.

    Outside [0, 1] the paper says nothing. An interaction that is over stays at its end: there the excess e
    becomes e / (1 + |e| / overrun), which is e near the interval and never more than ``overrun``. So members
    that ran past the end while sensors were blind wait close to it, keep their gradients and their response
    to measurements, and can be called back. This acts once in each prediction, so where exactly they wait
    depends a little on the rate of predictions.

    Args:
        overrun: how far beyond the interval a phase can get.
    """

    twins: ClassVar[dict[str, tuple[str, ...]]] = {
        "forward": ("advancer", "moved_covariance", "makes_new_members"),
        "hold": ("advancer", "moved_covariance"),
    }
    makes_new_members: ClassVar[bool] = True
    """Its result is never its argument, so that noise can be added in place."""
    periodic: ClassVar[bool] = False
    """Whether phases are those of a circle."""

    def __init__(self, overrun: float = 0.05) -> None:
        super().__init__()
        self.overrun = as_number("overrun", overrun, 0, above=True)

    @property
    @abstractmethod
    def moving(self) -> int:
        """m, how many leading entries of a state it moves."""

    @abstractmethod
    def velocity(self, moving: Tensor) -> Tensor:
        """Phase velocity [...], 1/s, of what moves [..., m]."""

    @abstractmethod
    def first(self, primitive: InteractionPrimitive) -> Tensor:
        """What moves of each demonstration at its beginning, [N, m]; phases are 0."""

    @abstractmethod
    def noise(self, primitive: InteractionPrimitive) -> nn.Module:
        """Q of what moves, with parameters of its own: a module with ``cholesky(dt [...], steps)`` -> [..., m, m]."""

    def forward(self, members: Tensor, dt: Tensor) -> Tensor:
        """The members [..., E, n] after dt [...] seconds: the phase advances by its velocity times dt."""
        # A copy with one column exchanged costs a third of putting columns together.
        moved = members.clone()
        moved[..., 0] = self.hold(members[..., 0] + self.velocity(members[..., : self.moving]) * dt[..., None])
        return moved

    def advancer(self, moving: Tensor) -> Callable[[float | Tensor], None]:
        """The same in place for members that are columns.

        Args:
            moving: [..., m, E], what moves of them; others hold it, too.

        Returns:
            A function of dt in seconds, one number or [...].
        """
        return _Advance(self, moving)

    def hold(self, phase: Tensor) -> Tensor:
        """Phases [...] with what lies beyond the interval drawn in: e becomes e overrun / (overrun + |e|)."""
        inside = phase.clamp(0, 1)
        excess = phase - inside
        return torch.addcdiv(inside, excess, excess.abs() + self.overrun, value=self.overrun)

    def slope(self, mean: Tensor, dt: Tensor) -> Tensor:
        """Derivative [...] of the phase in dt [...] seconds by that of the mean [..., n]: 1 within the interval."""
        return self.held_slope(mean[..., 0] + self.velocity(mean[..., : self.moving]) * dt)

    def held_slope(self, phase: Tensor) -> Tensor:
        """Derivative [...] of `hold` at a phase [...]: 1 within the interval."""
        excess = (phase - phase.clamp(0, 1)).abs()
        return (1 + excess / self.overrun).pow(-2)

    @abstractmethod
    def transition(self, dt: Tensor) -> Tensor:
        """G of what moves, [..., m, m], within the interval: what is after dt [...] seconds by what was before."""

    def moved_covariance(self, mean: Tensor, covariance: Tensor, dt: Tensor) -> Tensor:
        """G Sigma G', [..., n, n], in O(n): G differs from the identity in its leading rows only.

        Args:
            mean: [..., n].
            covariance: Sigma, [..., n, n].
            dt: [...], seconds.
        """
        m, G = self.moving, self.transition(dt)
        slope = self.slope(mean, dt).unsqueeze(-1)
        held = torch.cat([slope, torch.ones_like(slope).expand(*slope.shape[:-1], m - 1)], -1).unsqueeze(-1) * G
        rows = held @ covariance[..., :m, :]
        corner = rows[..., :m] @ held.transpose(-1, -2)
        # What rounding made asymmetric does not pile up.
        moved = torch.lerp(covariance, covariance.transpose(-1, -2), 0.5)
        moved[..., :m, m:] = rows[..., m:]
        moved[..., m:, :m] = rows[..., m:].transpose(-1, -2)
        moved[..., :m, :m] = torch.lerp(corner, corner.transpose(-1, -2), 0.5)
        return moved

    def select(self, view: View) -> PhaseModel:
        """The same for a view of the model: it moves what all DoFs share."""
        return self

    def extra_repr(self) -> str:
        """How far a phase can get."""
        return f"overrun={self.overrun:g}"


class _Advance:
    """Advances members that are columns, [..., m, E]. An object, so that copies of it advance copies of them."""

    def __init__(self, model: PhaseModel, moving: Tensor) -> None:
        self._model, self._by_member, self._phase = model, moving.transpose(-1, -2), moving.select(-2, 0)
        velocity = model.velocity(self._by_member)
        view = velocity._is_view() and velocity._base is self._by_member._base
        self._velocity = velocity if view else None  # a view changes with its base

    def __call__(self, dt: float | Tensor) -> None:
        """Advance by dt seconds, one number or [...]."""
        phase, velocity = self._phase, self._velocity
        velocity = self._model.velocity(self._by_member) if velocity is None else velocity
        if isinstance(dt, Tensor):
            phase.addcmul_(velocity, dt.unsqueeze(-1))
        else:
            phase.add_(velocity, alpha=dt)
        low, high = torch.aminmax(phase)
        if float(low) < 0 or float(high) > 1:
            phase.copy_(self._model.hold(phase))
