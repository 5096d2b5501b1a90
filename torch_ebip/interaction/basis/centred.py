"""What Gaussians and sigmoids share: one curve, shifted to evenly spaced centres."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_number
from torch_ebip.interaction.basis.base import Basis


class CentredBasis(Basis):
    """curve((phi - c_b) / width) with centres c_b evenly from 0 to 1, and on request a constant.

    Args:
        n_features: number of functions, the constant of `offset` included.
        width: scale of the curve, in phase; default: `share_of_spacing` of the spacing of the centres.
        offset: make the last of the functions a constant, which these families represent badly without.

    Raises:
        ValueError: too few functions, or a width that is not positive.
    """

    share_of_spacing = 1.0
    stretch = 1.0
    """The curve's unit in widths."""
    steepness: Tensor
    offsets: Tensor

    def __init__(self, n_features: int, width: float | None = None, offset: bool = False) -> None:
        super().__init__(n_features)
        name, count = type(self).__name__, n_features - offset
        if count < 1:
            raise ValueError(f"{name}: n_features={n_features} leaves no function beside the offset")
        self.offset = offset
        width = self.share_of_spacing / max(count - 1, 1) if width is None else width
        self.width = as_number(f"{name}: width", width, 0, above=True, of="in phase")
        middle = torch.tensor([0.5], dtype=torch.float64, device="cpu")
        centres = middle if count == 1 else torch.linspace(0, 1, count, dtype=torch.float64, device="cpu")
        # Tensors: arithmetic with a Python number first makes one of it, which costs more than small arithmetic.
        steepness = torch.tensor(1 / (self.stretch * self.width), dtype=torch.float64, device="cpu")
        self.register_buffer("steepness", owned(steepness), persistent=False)
        self.register_buffer("offsets", owned(-centres * steepness), persistent=False)

    @abstractmethod
    def curve(self, distance: Tensor) -> Tensor:
        """The curve [...] at distances [...] from its centre, in units of ``stretch`` widths."""

    @abstractmethod
    def slope(self, distance: Tensor, values: Tensor) -> Tensor:
        """Its derivative [...] by the distance [...], where its values [...] there are known already."""

    def evaluate(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Values and slopes; see `Basis.evaluate`."""
        steepness, offsets = self._line(phase)
        distance = torch.addcmul(offsets, phase.unsqueeze(-1), steepness)
        values = self.curve(distance)
        slopes = self.slope(distance, values) * steepness
        if self.offset:
            one = torch.ones_like(values[..., :1])
            return torch.cat([values, one], dim=-1), torch.cat([slopes, torch.zeros_like(one)], dim=-1)
        return values, slopes

    def within(self, phase: Tensor) -> Tensor:
        """See `Basis.within`: without the slopes."""
        steepness, offsets = self._line(phase)
        values = self.curve(torch.addcmul(offsets, phase.unsqueeze(-1), steepness))
        return torch.cat([values, torch.ones_like(values[..., :1])], dim=-1) if self.offset else values

    def by_function(self, phase: Tensor) -> Tensor:
        """See `Basis.by_function`."""
        steepness, offsets = self._line(phase)
        values = self.curve(torch.addcmul(offsets.unsqueeze(-1), phase.unsqueeze(-2), steepness))
        return torch.cat([values, torch.ones_like(values[..., :1, :])], dim=-2) if self.offset else values

    def _line(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Slope and intercepts of the curve's argument as a function of phase."""
        steepness, offsets = self.steepness, self.offsets
        if offsets.dtype != phase.dtype or offsets.device != phase.device:
            return steepness.to(phase), offsets.to(phase)
        return steepness, offsets

    def settings(self) -> dict[str, int | float | bool]:
        """See `Basis.settings`."""
        return {"n_features": self.n_features, "width": self.width, "offset": self.offset}

    def extra_repr(self) -> str:
        """The settings; see `Basis.extra_repr`."""
        return f"n_features={self.n_features}, width={self.width:.6g}, offset={self.offset}"
