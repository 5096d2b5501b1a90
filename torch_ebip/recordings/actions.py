"""Four actions whose ends look alike, of any number: what was seen first decides what the robot should do last.

A hand makes one of four gestures on its way, and then reaches for a place that has nothing to do with which it was.
The arm goes to where place and gesture together say. Whoever looks at the last moments only knows half of it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_ebip.common.arguments import as_count
from torch_ebip.recordings.demonstrations import Demonstrations
from torch_ebip.recordings.layout import Layout, Modality

NAMES = ("lift", "swing", "circle", "nod")
RATE = 30.0
"""Hz."""
TREMOR = 0.006
"""Of the hand, m."""


def actions(count: int, seed: int = 0) -> Demonstrations:
    """Simulated interactions with a label each: a hand's position (m), and three joints of an arm (rad), 30 Hz.

    Args:
        count: how many; the four in turn.
        seed: of all draws.

    Raises:
        ValueError: a count that is not a whole number from 1 on.

    Example:
        >>> from torch_ebip.recordings import actions
        >>> made = actions(8)
        >>> made.labels[:4]
        ('lift', 'swing', 'circle', 'nod')
    """
    draws = torch.Generator("cpu").manual_seed(seed)
    paths, labels = [], []
    for i in range(as_count("count", count)):
        which = i % len(NAMES)
        paths.append(_one(which, draws))
        labels.append(NAMES[which])
    layout = Layout(
        [
            Modality("hand", ["hand.x", "hand.y", "hand.z"], "m"),
            Modality("arm", ["pan", "lift", "elbow"], "rad", controlled=True),
        ]
    )
    return Demonstrations(layout, paths, RATE, labels=labels)


def _one(which: int, draws: torch.Generator) -> Tensor:
    """[T, 6], float32: one interaction of an action."""

    def noise(*size: int) -> Tensor:
        """Standard normal."""
        return torch.randn(size, generator=draws, dtype=torch.float64, device="cpu")

    def table(*rows: object) -> Tensor:
        """Numbers."""
        return torch.tensor(rows, dtype=torch.float64, device="cpu")

    length = int(torch.randint(60, 91, (), generator=draws, device="cpu"))
    phase = torch.linspace(0, 1, length, dtype=torch.float64, device="cpu")
    bent = phase + 0.05 * float(noise()) * torch.sin(math.pi * phase)
    size = 1 + 0.25 * float(noise())
    place = table(0.5, 0.0, 0.2) + 0.1 * noise(3)
    gesture = size * _gesture(which, (bent / 0.45).clamp(0, 1))
    reach = _minimum_jerk(((bent - 0.35) / 0.65).clamp(0, 1)).unsqueeze(-1)
    hand = gesture + place * reach + TREMOR * noise(length, 3)
    home = table(0.0, -1.2, 1.6)
    turn = table([0.0, 1.5, 0.0], [0.8, 0.0, -1.0], [-0.9, 0.0, 0.6])
    kind = table([0.5, 0.2, -0.3], [-0.5, 0.3, 0.2], [0.4, -0.4, 0.3], [-0.3, -0.3, -0.4])
    goal = turn @ (place - table(0.5, 0.0, 0.2)) + kind[which]
    goal = goal + 0.03 * noise(3)
    arm = home + goal * _minimum_jerk(((bent - 0.3) / 0.7).clamp(0, 1)).unsqueeze(-1)
    return torch.cat([hand, arm], -1).float()


def _gesture(which: int, part: Tensor) -> Tensor:
    """[T, 3], m: what the hand does on the way, nothing at its beginning (0) and its end (1)."""
    bump = torch.sin(math.pi * part).square()
    zero = torch.zeros_like(part)
    if which == 0:
        return torch.stack([zero, zero, 0.12 * bump], -1)
    if which == 1:
        return torch.stack([zero, 0.12 * bump, zero], -1)
    if which == 2:
        turn = 2 * math.pi * part
        return torch.stack([zero, 0.07 * torch.sin(turn) * bump.sqrt(), 0.06 * (1 - torch.cos(turn))], -1)
    return torch.stack([0.08 * torch.sin(2 * math.pi * part) * bump.sqrt(), zero, -0.06 * bump], -1)


def _minimum_jerk(part: Tensor) -> Tensor:
    """Flash and Hogan's way from 0 to 1."""
    return 10 * part**3 - 15 * part**4 + 6 * part**5
