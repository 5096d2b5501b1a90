"""What sensors do to a recording: lost, frozen, spiked, drifting, late, swapped. NaN is what was not measured."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip import Demonstrations, Layout
from torch_ebip.common.draws import seeded

Damage = Callable[[Tensor, "Wear"], Tensor]
"""From a trajectory [T, D] to what sensors say of it."""

GROUPS = ("clean", "without", "lost", "back", "frozen", "spikes", "drift", "missing", "jitter", "swapped")
"""Kinds of faults."""


class Wear(NamedTuple):
    """What a fault may need to know.

    Attributes:
        layout: of the trajectory.
        rate: Hz.
        deviation: [D], of each DoF over the demonstrations.
        generator: of the interaction's own draws.
    """

    layout: Layout
    rate: float
    deviation: Tensor
    generator: torch.Generator


class Fault(NamedTuple):
    """A kind of fault.

    Attributes:
        name: as it stands in the table.
        group: of similar ones.
        sensor: which modality has it; None for all.
        damage: does it.
    """

    name: str
    group: str
    sensor: str | None
    damage: Damage


def lost(sensor: str, start: float, stop: float = 1.0) -> Damage:
    """Says nothing between two shares of the interaction."""

    def damage(trajectory: Tensor, wear: Wear) -> Tensor:
        """NaN."""
        length = len(trajectory)
        trajectory[round(start * length) : round(stop * length), wear.layout.slice(sensor)] = math.nan
        return trajectory

    return damage


def frozen(sensor: str, start: float) -> Damage:
    """Repeats what it said at a share of the interaction, or last before it."""

    def damage(trajectory: Tensor, wear: Wear) -> Tensor:
        """Each DoF its own last value; nothing, if it had none."""
        part = trajectory[:, wear.layout.slice(sensor)]
        first = round(start * len(part))
        steps = torch.arange(first + 1).unsqueeze(-1)
        last = torch.where(part[: first + 1].isnan(), -1, steps).amax(0)
        held = part.gather(0, last.clamp(min=0).unsqueeze(0))[0]
        part[first:] = torch.where(last >= 0, held, math.nan)
        return trajectory

    return damage


def spikes(deviations: float, share: float) -> Damage:
    """Each sample of each sensor is, with probability ``share``, off by so many deviations, DoF by DoF up or down."""

    def damage(trajectory: Tensor, wear: Wear) -> Tensor:
        """Added."""
        hit = _by_sensor(trajectory, wear, share)
        signs = 2 * torch.randint(2, trajectory.shape, generator=wear.generator) - 1
        return trajectory + torch.where(hit, deviations * wear.deviation * signs, 0)

    return damage


def drift(sensor: str, deviations: float) -> Damage:
    """A bias that grows evenly, to so many deviations at the end of the interaction, in a direction of its own."""

    def damage(trajectory: Tensor, wear: Wear) -> Tensor:
        """Added."""
        part = wear.layout.slice(sensor)
        direction = torch.randn(part.stop - part.start, generator=wear.generator)
        direction = direction / direction.square().mean().sqrt()
        growth = torch.linspace(0, 1, len(trajectory)).unsqueeze(-1)
        trajectory[:, part] += deviations * growth * direction * wear.deviation[part]
        return trajectory

    return damage


def dropouts(share: float, length: int = 1) -> Damage:
    """Stretches of ``length`` samples of each sensor are missing, that share of all of them."""

    def damage(trajectory: Tensor, wear: Wear) -> Tensor:
        """NaN."""
        begins = _by_sensor(trajectory, wear, 1 - (1 - share) ** (1 / length))
        gone = begins.clone()
        for late in range(1, length):
            gone[late:] |= begins[:-late]
        return torch.where(gone, math.nan, trajectory)

    return damage


def jitter(seconds: float) -> Damage:
    """Each sample of each sensor is one from up to so many seconds before, and does not say so."""

    def damage(trajectory: Tensor, wear: Wear) -> Tensor:
        """Late."""
        latest = round(seconds * wear.rate)
        count = len(wear.layout.modalities)
        delays = torch.randint(latest + 1, (len(trajectory), count), generator=wear.generator)
        source = (torch.arange(len(trajectory)).unsqueeze(-1) - delays).clamp(min=0)
        return trajectory.gather(0, source[:, wear.layout.modality_of_dof])

    return damage


def swapped(first: str, second: str) -> Damage:
    """Two sensors of one kind are mistaken for each other."""

    def damage(trajectory: Tensor, wear: Wear) -> Tensor:
        """Exchanged."""
        a, b = wear.layout.slice(first), wear.layout.slice(second)
        both = trajectory.clone()
        both[:, a], both[:, b] = trajectory[:, b], trajectory[:, a]
        return both

    return damage


def catalogue(layout: Layout, sensors: Sequence[str], starts: Sequence[float]) -> list[Fault]:
    """Every fault of the study, the clean recording first.

    Args:
        layout: of the recordings.
        sensors: modalities that are shown.
        starts: shares of the interaction at which sensors are lost; those lost at the middle one come back a fifth
            later in another fault, and freeze then in a third.
    """
    middle = starts[len(starts) // 2]
    found = [Fault("clean", "clean", None, lambda trajectory, wear: trajectory)]
    found += [Fault(f"without {name}", "without", name, lost(name, 0.0)) for name in sensors]
    found += [Fault(f"{name} lost at {s:.0%}", "lost", name, lost(name, s)) for s in starts for name in sensors]
    found += [
        Fault(f"{name} lost, {s:.0%} to {s + 0.2:.0%}", "back", name, lost(name, s, s + 0.2))
        for s in starts[1:-1]
        for name in sensors
    ]
    found += [Fault(f"{name} frozen at {middle:.0%}", "frozen", name, frozen(name, middle)) for name in sensors]
    found += [
        Fault(f"spikes of {size:g} sd, {share:.0%}", "spikes", None, spikes(size, share))
        for size in (10.0, 1000.0)
        for share in (0.01, 0.1)
    ]
    found += [Fault(f"{name} drifts to 1 sd", "drift", name, drift(name, 1.0)) for name in sensors]
    found += [
        Fault("NaN bursts of 5, 20%", "missing", None, dropouts(0.2, 5)),
        Fault("dropouts, 20%", "missing", None, dropouts(0.2)),
        Fault("late by 0 to 100 ms", "jitter", None, jitter(0.1)),
    ]
    pairs = [(a, b) for a, b in (("shoe_left", "shoe_right"),) if {a, b} <= set(sensors)]
    found += [Fault(f"{a} and {b} swapped", "swapped", None, swapped(a, b)) for a, b in pairs]
    return found


def suffer(
    fault: Fault, tests: Demonstrations, sensors: Sequence[str], deviation: Tensor, numbers: Sequence[int], seed: int
) -> Demonstrations:
    """What sensors say of interactions; what else was recorded stays as it is.

    Args:
        fault: that they have.
        tests: B interactions, with these ``numbers``, on which their draws depend.
        sensors: modalities that are shown.
        deviation: [D], of each DoF over the demonstrations.
        seed: of the draws.
    """
    layout, shown = tests.layout, tests.layout.mask(sensors)
    said = []
    for number, trajectory in zip(numbers, tests, strict=True):
        wear = Wear(layout, tests.rate, deviation, seeded(seed, number, 1))
        damaged = fault.damage(trajectory.clone(), wear)
        said.append(torch.where(shown, damaged, trajectory))
    return Demonstrations(layout, said, tests.rate)


def _by_sensor(trajectory: Tensor, wear: Wear, share: float) -> Tensor:
    """bool [T, D]: samples that are hit, all DoFs of a sensor together."""
    draws = torch.rand(len(trajectory), len(wear.layout.modalities), generator=wear.generator)
    return (draws < share)[:, wear.layout.modality_of_dof]
