"""Made-up interactions that repeat: a person waves two to six times, faster and slower, larger and smaller; so does
the partner."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip import Demonstrations, Layout, Modality

RATE = 30.0
"""Hz."""
HARMONICS, MANNERS = 3, 3


class Waves(NamedTuple):
    """Recordings, and what nobody could measure.

    Attributes:
        recordings: of a ``hand`` and of a ``partner``, three DoFs each, m.
        phases: of each, [T], in cycles since phase 0, not wrapped.
    """

    recordings: Demonstrations
    phases: list[Tensor]


def waves(count: int, seed: int = 0, anywhere: bool = False, noise: float = 0.005, movement: int = 0) -> Waves:
    """Of so many people: each with a shape of their own, at a speed and of a size that change while they wave.

    Args:
        count: of recordings.
        seed: of all draws.
        anywhere: recordings begin anywhere in a cycle; default: at its beginning.
        noise: deviation of the sensors, m.
        movement: seed of what all people have in common.
    """
    draws = torch.Generator("cpu").manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        """Standard normal."""
        return torch.randn(shape, generator=draws, device="cpu", dtype=torch.float64)

    def uniform(low: float, high: float) -> float:
        """Between two numbers."""
        return low + (high - low) * float(torch.rand((), generator=draws, device="cpu"))

    order = torch.arange(1, HARMONICS + 1, dtype=torch.float64, device="cpu")
    common = torch.Generator("cpu").manual_seed(1_000_003 + movement)
    shapes = torch.randn(MANNERS + 1, 2, 6, HARMONICS, generator=common, dtype=torch.float64, device="cpu")
    usual, manners = shapes[0] * torch.tensor([0.12, 0.04, 0.015], dtype=torch.float64, device="cpu"), shapes[1:]
    middle = torch.randn(6, generator=common, dtype=torch.float64, device="cpu")
    recordings, phases = [], []
    for _ in range(count):
        cycles, period = uniform(2, 6), uniform(0.9, 2.2)
        n = round(cycles * period * RATE) + 1
        time = torch.arange(n, dtype=torch.float64, device="cpu") / RATE
        length = float(time[-1])
        wobble = 0.1 * torch.sin(2 * math.pi * (uniform(0.15, 0.5) * time / period + uniform(0, 1)))
        speed = torch.exp(wobble + uniform(-0.3, 0.3) * (time / length - 0.5)) / period
        phase = torch.cat([speed.new_zeros(1), 0.5 * (speed[1:] + speed[:-1]).cumsum(0) / RATE])
        phase = phase + (uniform(0, 1) if anywhere else 0.0)
        size = uniform(0.7, 1.3) * torch.exp(uniform(-0.4, 0.4) * (time / length - 0.5))
        # A person's manner shows in the hand, and the partner answers it.
        manner = torch.einsum("m,mpdh->pdh", normal(MANNERS), manners) / MANNERS**0.5
        own = usual + usual.abs() * (0.25 * manner + 0.03 * normal(2, 6, HARMONICS))
        angle = 2 * math.pi * order * phase.unsqueeze(-1)  # [T, H]
        path = torch.cos(angle) @ own[0].T + torch.sin(angle) @ own[1].T
        where = middle + 0.005 * normal(6)
        values = where + size.unsqueeze(-1) * path + noise * normal(n, 6)
        recordings.append(values.float())
        phases.append(phase)
    layout = Layout(
        [
            Modality("hand", ["x", "y", "z"], "m"),
            Modality("partner", ["partner.x", "partner.y", "partner.z"], "m", controlled=True),
        ]
    )
    return Waves(Demonstrations(layout, recordings, RATE), phases)
