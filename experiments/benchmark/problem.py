"""An interaction of a given size to be filtered, made up: smooth movements, every demonstration a random one."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip import EnsembleFilter, GaussianBasis, InteractionPrimitive, Layout, Modality, StackedBasis, ebip

FUNCTIONS = 13
"""Gaussians a DoF: 43 DoFs have the 559 weights of the paper's state."""
RATE = 60.0


class Problem(NamedTuple):
    """A filter and what it sees.

    Attributes:
        filter: the paper's eBIP.
        weighted: the same with members weighed by evidence.
        sensors: bool [D], the DoFs that are measured.
        y: [T, D], an interaction from its beginning to nine tenths of it, with noise.
    """

    filter: EnsembleFilter
    weighted: EnsembleFilter
    sensors: Tensor
    y: Tensor

    @property
    def n_weights(self) -> int:
        """How many weights there are."""
        return int(self.filter.prior.states.shape[-1]) - 2


def make_problem(
    n_weights: int, members: int, sensors: int, dtype: torch.dtype, samples: int = 100, seed: int = 0
) -> Problem:
    """About ``n_weights`` weights (a multiple of `FUNCTIONS`), E members, D_o DoFs that are measured."""
    generator = torch.Generator().manual_seed(seed)
    dofs = max(sensors, round(n_weights / FUNCTIONS))
    modalities = [Modality("sensors", [f"s{i}" for i in range(sensors)], "m")]
    if dofs > sensors:
        modalities.append(Modality("robot", [f"r{i}" for i in range(dofs - sensors)], "rad", controlled=True))
    layout = Layout(modalities)
    # A few causes behind all movements, as in people, and something of its own in each weight.
    causes = torch.randn(members + 1, 8, generator=generator)
    loadings = torch.randn(8, dofs * FUNCTIONS, generator=generator)
    weights = causes @ loadings / 8 + 0.1 * torch.randn(members + 1, dofs * FUNCTIONS, generator=generator)
    duration = samples / RATE / 0.9
    velocity = (1 + 0.05 * torch.randn(members + 1, generator=generator)) / duration
    basis, one = StackedBasis([GaussianBasis(FUNCTIONS)] * dofs), torch.ones(dofs)
    known = [tensor.to(dtype) for tensor in (weights[1:], velocity[1:], 0.01 * one, one, one)]
    primitive = InteractionPrimitive(layout, basis, RATE, *known)
    y = basis.project(torch.arange(samples) / RATE * velocity[0], weights[0])
    y = y + 0.1 * torch.randn(y.shape, generator=generator)
    return Problem(ebip(primitive), ebip(primitive, weigh=True), layout.mask(["sensors"]), y.to(dtype))
