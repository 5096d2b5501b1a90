"""What sensors say that lie, and movements that are none: beside those of `experiments.faults`."""

from __future__ import annotations

import torch
from torch import Tensor

from experiments.faults.faults import Damage, Fault, Wear, drift, frozen, lost, spikes
from torch_ebip import Layout


def offset(sensor: str, size: float) -> Damage:
    """Off by so much from the beginning, in the unit of the sensor, in a direction of its own."""

    def damage(trajectory: Tensor, wear: Wear) -> Tensor:
        """Added."""
        part = wear.layout.slice(sensor)
        direction = torch.randn(part.stop - part.start, generator=wear.generator)
        trajectory[:, part] += size * direction / direction.norm()
        return trajectory

    return damage


def axes(sensor: str) -> Damage:
    """Its first two axes are taken for each other."""

    def damage(trajectory: Tensor, wear: Wear) -> Tensor:
        """Exchanged."""
        first = wear.layout.slice(sensor).start
        trajectory[:, [first, first + 1]] = trajectory[:, [first + 1, first]]
        return trajectory

    return damage


def unit(sensor: str, factor: float, share: float) -> Damage:
    """In another unit, for that share of the interaction."""

    def damage(trajectory: Tensor, wear: Wear) -> Tensor:
        """Multiplied."""
        trajectory[: round(share * len(trajectory)), wear.layout.slice(sensor)] *= factor
        return trajectory

    return damage


def walk(trajectory: Tensor, wear: Wear) -> Tensor:
    """A random walk from where the interaction began, of a tenth of each DoF's deviation a sample."""
    steps = 0.1 * wear.deviation * torch.randn(trajectory.shape, generator=wear.generator)
    return trajectory[:1] + steps.cumsum(0)


def backwards(trajectory: Tensor, wear: Wear) -> Tensor:
    """From its end to its beginning."""
    return trajectory.flip(0)


TRUTHLESS = ("random walk", "backwards")
"""There is nothing that forecasts of these could be compared with."""


def lies(layout: Layout, sensor: str, size: float, start: float = 0.43) -> list[Fault]:
    """All of them, the clean recording first.

    Args:
        layout: of the recordings.
        sensor: that lies, of two DoFs at least.
        size: of an offset, in its unit: half a metre, say.
        start: share of the interaction at which it freezes, or is lost.
    """
    return [
        Fault("clean", "clean", None, lambda trajectory, wear: trajectory),
        Fault(f"without {sensor}", "without", sensor, lost(sensor, 0.0)),
        Fault(f"{sensor} lost at {start:.0%}", "lost", sensor, lost(sensor, start)),
        Fault(f"{sensor} off by {size:g}", "offset", sensor, offset(sensor, size)),
        Fault(f"{sensor} in thousandths at first", "unit", sensor, unit(sensor, 1000.0, 0.15)),
        Fault(f"{sensor} with swapped axes", "axes", sensor, axes(sensor)),
        Fault(f"{sensor} frozen at {start:.0%}", "frozen", sensor, frozen(sensor, start)),
        Fault(f"{sensor} drifts to 1 sd", "drift", sensor, drift(sensor, 1.0)),
        Fault("spikes of 10 sd, 10%", "spikes", None, spikes(10.0, 0.1)),
        Fault("random walk", "walk", None, walk),
        Fault("backwards", "backwards", None, backwards),
    ]
