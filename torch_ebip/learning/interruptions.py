"""Interruptions, made of recordings that have none: people who pause, idle at the start, are seen late, start over.

What is recorded while a person stands still is where they stood, with the noise of the sensors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.recordings.demonstrations import Demonstrations


class Interrupted(NamedTuple):
    """A recording and what it was made of.

    Attributes:
        values: [T', D], units of the DoFs.
        source: int64 [T'], which sample of the recording each of them is of.
        over: the first sample after which nothing is interrupted any more.
    """

    values: Tensor
    source: Tensor
    over: int

    def __repr__(self) -> str:
        return brief(self)


Interruption = Callable[[Tensor, float, Tensor, torch.Generator], Interrupted]
"""Of a recording [T, D], its rate in Hz, deviations of the noise [D] and a generator of the draws."""


def pause(least: float, most: float, shares: tuple[float, float] = (0.2, 0.7)) -> Interruption:
    """Standing still for some seconds, between two shares of the interaction.

    Args:
        least, most: s.
        shares: of the interaction, between which it happens.
    """

    def made(values: Tensor, rate: float, noise: Tensor, generator: torch.Generator) -> Interrupted:
        """One pause."""
        length = round(_between(least, most, generator) * rate)
        at = int(_between(*shares, generator) * (len(values) - 1))
        return _standing(values, at, length, noise, generator)

    return made


def idle(least: float, most: float) -> Interruption:
    """Standing still for some seconds where the interaction begins."""
    return pause(least, most, (0.0, 0.0))


def late(least: float, most: float) -> Interruption:
    """First seen at a share of the interaction."""

    def made(values: Tensor, rate: float, noise: Tensor, generator: torch.Generator) -> Interrupted:
        """What is left of it."""
        first = round(_between(least, most, generator) * (len(values) - 1))
        return Interrupted(values[first:], torch.arange(first, len(values)), 0)

    return made


def again(least: float, most: float) -> Interruption:
    """Begun, and from a share of the interaction on begun anew."""

    def made(values: Tensor, rate: float, noise: Tensor, generator: torch.Generator) -> Interrupted:
        """A part of it, and all of it."""
        first = max(round(_between(least, most, generator) * (len(values) - 1)), 1)
        whole = torch.arange(len(values))
        return Interrupted(torch.cat([values[:first], values]), torch.cat([whole[:first], whole]), first)

    return made


def at_speed(factor: float) -> Interruption:
    """All of it so many times as fast; between samples linear, NaN beside NaN."""

    def made(values: Tensor, rate: float, noise: Tensor, generator: torch.Generator) -> Interrupted:
        """The same way on another clock."""
        moved, place = played_at(values, factor)
        return Interrupted(moved, place.round().long(), 0)

    return made


def played_at(values: Tensor, speed: float) -> tuple[Tensor, Tensor]:
    """A recording [T, D] so many times as fast on the same clock, [T', D], and where in it each sample is, [T']."""
    last = len(values) - 1
    place = (torch.arange(int(last / speed) + 1, dtype=torch.float64) * speed).clamp(max=last)
    low = place.floor().long().clamp(max=max(last - 1, 0))
    part = (place - low).to(values).unsqueeze(-1)
    return torch.lerp(values[low], values[(low + 1).clamp(max=last)], part), place


def undisturbed(values: Tensor, rate: float, noise: Tensor, generator: torch.Generator) -> Interrupted:
    """The recording [T, D] as it is, whatever its rate, the noise [D] and the draws."""
    return Interrupted(values, torch.arange(len(values)), 0)


def interrupted(
    demonstrations: Demonstrations, kinds: list[Interruption], noise: Tensor, generator: torch.Generator
) -> list[Interrupted]:
    """Every recording with one interruption, the kinds in turn.

    Args:
        demonstrations: N of them.
        kinds: of interruptions.
        noise: [D], deviations of what sensors say while nothing moves, units of the DoFs.
        generator: of when and for how long.
    """
    return [
        kinds[i % len(kinds)](values, demonstrations.rate, noise.to(values), generator)
        for i, values in enumerate(demonstrations)
    ]


def _standing(values: Tensor, at: int, length: int, noise: Tensor, generator: torch.Generator) -> Interrupted:
    """Of so many samples more, all where the one ``at`` was."""
    shape = (length, values.shape[-1])
    still = values[at] + noise * torch.randn(shape, generator=generator, dtype=values.dtype)
    whole = torch.arange(len(values))
    source = torch.cat([whole[: at + 1], whole[at].expand(length), whole[at + 1 :]])
    return Interrupted(torch.cat([values[: at + 1], still, values[at + 1 :]]), source, at + 1 + length)


def _between(least: float, most: float, generator: torch.Generator) -> float:
    return least + (most - least) * float(torch.rand((), generator=generator))
