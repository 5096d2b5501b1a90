"""Reaches for something that a robot holds out, of any number: as they were shown, and as nobody showed them.

A hand goes from its side of a table to a place in front of it, and the arm brings what it holds to where the hand
will be; what it does there depends on the place in a way that bends. Head and elbow of the person are seen, too:
three sensors that say different things of the same movement, each at its own noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip import Demonstrations, Layout, Modality
from torch_ebip.common.draws import seeded

RATE = 30.0
"""Hz."""
LAYOUT = Layout(
    [
        Modality("hand", ["hand.x", "hand.y", "hand.z"], "m"),
        Modality("elbow", ["elbow.x", "elbow.y", "elbow.z"], "m"),
        Modality("head", ["head.yaw", "head.pitch"], "rad"),
        Modality("arm", ["pan", "lift", "elbow_joint"], "rad", controlled=True),
    ]
)
START, GOAL = (0.0, -0.3, 0.0), (0.45, 0.1, 0.25)
"""Of the hand, m: the middle of where it begins, and of where it goes."""


class Reach(NamedTuple):
    """One person's way.

    Attributes:
        start, goal: [3], m.
        bow: [3], m: how far the way bends from the straight line in its middle.
        length: samples.
        lag: share of the interaction by which the elbow leads.
        skew: by how much the first half is slower than the second.
    """

    start: Tensor
    goal: Tensor
    bow: Tensor
    length: int
    lag: float
    skew: float


Change = Callable[[Reach, Callable[..., Tensor]], Reach]
"""What of a reach is other than in those that were shown, by normal draws of its own."""


def _slower(reach: Reach, noise: Callable[..., Tensor]) -> Reach:
    """Twice to two and a half times as long as the longest of those that were shown."""
    return reach._replace(length=int(180 + 45 * torch.special.ndtr(noise())))


def _faster(reach: Reach, noise: Callable[..., Tensor]) -> Reach:
    """Less than half as long as the shortest."""
    return reach._replace(length=int(20 + 8 * torch.special.ndtr(noise())))


def _elsewhere(reach: Reach, noise: Callable[..., Tensor]) -> Reach:
    """A third of a metre from where hands began."""
    return reach._replace(start=reach.start + _direction(noise) * 0.35)


def _detour(reach: Reach, noise: Callable[..., Tensor]) -> Reach:
    """A quarter of a metre around something."""
    return reach._replace(bow=reach.bow + _direction(noise) * 0.25)


def _goal(reach: Reach, noise: Callable[..., Tensor]) -> Reach:
    """A third of a metre from where hands went."""
    return reach._replace(goal=reach.goal + _direction(noise) * 0.35)


def _direction(noise: Callable[..., Tensor]) -> Tensor:
    """[3], of length 1."""
    draw = noise(3)
    return draw / draw.norm()


STRANGE: dict[str, Change] = {
    "slower": _slower,
    "faster": _faster,
    "other start": _elsewhere,
    "detour": _detour,
    "other goal": _goal,
}
"""Kinds of reaches that are not among those that were shown."""


def reaches(count: int, seed: int = 0, change: Change | None = None) -> Demonstrations:
    """Simulated reaches, 30 Hz, in the units of `LAYOUT`.

    Args:
        count: how many.
        seed: of all draws.
        change: what is strange about them; default: nothing.
    """
    return Demonstrations(LAYOUT, [_one(seeded(seed, i), change) for i in range(count)], RATE)


def _one(draws: torch.Generator, change: Change | None) -> Tensor:
    """[T, 11], float32."""

    def noise(*size: int) -> Tensor:
        """Standard normal."""
        return torch.randn(size, generator=draws, dtype=torch.float64, device="cpu")

    def table(*rows: float) -> Tensor:
        """Numbers."""
        return torch.tensor(rows, dtype=torch.float64, device="cpu")

    reach = Reach(
        table(*START) + 0.04 * noise(3),
        table(*GOAL) + 0.08 * noise(3),
        table(0.0, 0.0, 0.06) + 0.02 * noise(3),
        int(torch.randint(60, 91, (), generator=draws, device="cpu")),
        0.05 + 0.02 * float(noise()),
        0.1 * float(noise()),
    )
    if change is not None:
        reach = change(reach, noise)
    time = torch.linspace(0, 1, reach.length, dtype=torch.float64, device="cpu")
    phase = time + reach.skew * 0.3 * torch.sin(math.pi * time)
    hand = _way(reach, phase)
    shoulder = table(-0.1, -0.1, 0.3) + 0.02 * noise(3)
    early = _way(reach, phase + reach.lag)
    elbow = 0.5 * (shoulder + early) - table(0.0, 0.0, 0.12)
    goal = reach.goal - table(*GOAL)
    looked = torch.stack([torch.atan2(reach.goal[1], reach.goal[0] + 0.3), torch.atan2(reach.goal[2], table(0.8)[0])])
    head = looked * _minimum_jerk(phase / 0.4).unsqueeze(-1) + 0.03 * noise(2)
    bent = torch.tanh(2 * goal)
    joints = (
        table(0.2, -1.0, 1.4)
        + torch.stack(
            [1.2 * bent[1] - 0.5 * goal[0], 0.8 * bent[2] + 2.0 * goal[0] * goal[1], -0.9 * bent[0] + 0.4 * bent[2]]
        )
        * 1.0
    )
    home = table(0.0, -1.4, 1.9)
    arm = home + (joints + 0.02 * noise(3) - home) * _minimum_jerk((phase - 0.25) / 0.75).unsqueeze(-1)
    steps = reach.length
    hand = hand + 0.004 * noise(steps, 3)
    elbow, head = elbow + 0.006 * noise(steps, 3), head + 0.02 * noise(steps, 2)
    return torch.cat([hand, elbow, head, arm], -1).float()


def _way(reach: Reach, phase: Tensor) -> Tensor:
    """[T, 3], m, of the hand at phases [T]."""
    along = _minimum_jerk(phase).unsqueeze(-1)
    return reach.start + (reach.goal - reach.start) * along + reach.bow * torch.sin(math.pi * along)


def _minimum_jerk(part: Tensor) -> Tensor:
    """Flash and Hogan's way from 0 to 1."""
    part = part.clamp(0, 1)
    return 10 * part**3 - 15 * part**4 + 6 * part**5
