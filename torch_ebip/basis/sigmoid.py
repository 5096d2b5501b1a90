"""Sigmoid basis functions (Bishop 2006, section 3.1)."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.basis.base import Basis, checked_width, spaced_centres, with_offset


class SigmoidBasis(Basis):
    """1 / (1 + exp(-(phi - c_b) / width)) with centres c_b evenly from 0 to 1.

    Args:
        n_features: number of functions, the constant of `offset` included.
        width: scale of the transition, in phase; default: half the spacing of the centres.
        offset: make one of the functions a constant.

    Raises:
        ValueError: too few functions, or a width that is not positive.
    """

    centres: Tensor

    def __init__(self, n_features: int, width: float | None = None, offset: bool = False) -> None:
        super().__init__(n_features)
        count = n_features - offset
        if count < 1:
            raise ValueError(f"SigmoidBasis: n_features={n_features} leaves no function beside the offset")
        self.offset = offset
        default = 0.5 / max(count - 1, 1)
        self.width = checked_width("SigmoidBasis", count, default if width is None else width)
        self.register_buffer("centres", spaced_centres(count), persistent=False)

    def evaluate(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Values and slopes; see `Basis.evaluate`."""
        values = torch.sigmoid((phase.unsqueeze(-1) - self.centres.to(phase)) / self.width)
        return with_offset(values, values * (1 - values) / self.width, self.offset)

    def extra_repr(self) -> str:
        """The settings; see `Basis.extra_repr`."""
        return f"n_features={self.n_features}, width={self.width:.6g}, offset={self.offset}"
