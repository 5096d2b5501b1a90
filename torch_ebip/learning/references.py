"""What can be said without a filter: the training mean, and the demonstration that is nearest so far."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.interaction.primitive import InteractionPrimitive

SLACK = 1e-4
"""Of a sample: so far from one a time may be rounded and still be its."""


def ends(primitive: InteractionPrimitive) -> Tensor:
    """[N, D]: where the demonstrations of a primitive end, units of the DoFs."""
    return primitive.basis.project(primitive.first_phase + primitive.cycles, primitive.weights)


def paths_after(primitive: InteractionPrimitive, time: Tensor, which: Tensor, dofs: Tensor) -> Tensor:
    """[..., D_dofs], units of the DoFs: where demonstrations are so long after they began, by their own regressions.

    Args:
        primitive: of the demonstrations.
        time: [...], s; infinity, and what lies behind the end of one, is its end.
        which: int64 [...], which demonstrations.
        dofs: bool [D], which DoFs.
    """
    used = dofs.to(primitive.weights.device)[primitive.basis.dof_of_weight().to(primitive.weights.device)]
    phase = primitive.phase_after(time.to(primitive.phase_velocity), which)
    return primitive.basis.select(dofs).project(phase, primitive.weights[:, used][which])


def last_measured(trajectory: Tensor) -> Tensor:
    """[D]: the last measured value of each DoF of a trajectory [T, D], NaN if the last twentieth has none.

    Args:
        trajectory: [T, D], units of the DoFs, NaN where not measured.
    """
    recent = trajectory[-max(1, len(trajectory) // 20) :]
    steps = torch.arange(len(recent), device=recent.device).unsqueeze(-1)
    last = torch.where(recent.isnan(), -1, steps).amax(0)
    return torch.where(last >= 0, recent.gather(0, last.clamp(min=0).unsqueeze(0))[0], torch.nan)


def recorded(values: Tensor, lengths: Tensor, ends: Tensor, now: Tensor, ahead: Tensor, rate: float) -> Tensor:
    """What was measured some seconds after some samples: [B, K, P, D].

    Between samples linear; NaN where it was not measured, or is behind the end. Infinitely far ahead: the end.

    Args:
        values: [B, T, D], units of the DoFs, NaN where not measured.
        lengths: int64 [B], samples.
        ends: [B, D], see `last_measured`.
        now: int64 [B, K], samples.
        ahead: [P], s.
        rate: samples a second, Hz.
    """
    last = (lengths - 1).view(-1, 1, 1)
    at = now.unsqueeze(-1) + torch.where(ahead.isinf(), 0, ahead).double() * rate
    before = (at + SLACK).floor().long()
    part = (at - before).clamp(min=0).to(values).unsqueeze(-1)
    rows = torch.arange(len(values), device=values.device).view(-1, 1, 1)
    first, second = (values[rows, torch.minimum(step, last)] for step in (before, before + 1))
    found = torch.where(part > SLACK, torch.lerp(first, second, part), first)
    # In float64: float32 has no place for so little beside the last sample, which would then lie behind the end.
    found = torch.where((at <= last.double() + SLACK).unsqueeze(-1), found, torch.nan)
    return torch.where(ahead.isinf().view(-1, 1), ends.view(len(values), 1, 1, -1), found)


def nearest(
    primitive: InteractionPrimitive,
    y: Tensor,
    observed: Tensor,
    keep: Tensor,
    dt: float,
    among: Tensor | None = None,
) -> Tensor:
    """The demonstrations that are nearest to what was seen, each running at its own speed.

    Distance: mean squared difference over what was measured, DoFs in units of their deviation.

    Args:
        primitive: of the demonstrations.
        y: [B, T, D], units of the DoFs.
        observed: bool [B, T, D].
        keep: int64 [B, K], up to which samples each is seen.
        dt: seconds between samples.
        among: int64 [B, E], which demonstrations may be chosen; default: all.

    Returns:
        int64 [B, K], which demonstrations.
    """
    used = observed.any(0).any(0)
    basis = primitive.basis.select(used)
    weights = primitive.weights[:, used.to(primitive.weights.device)[primitive.basis.dof_of_weight()]]
    time = torch.arange(y.shape[1], device=weights.device)[:, None] * dt
    phase = primitive.first_phase + time * primitive.phase_velocity
    variance = primitive.value_variance[used]
    deviation = torch.where(variance > 0, variance, torch.inf).sqrt()
    paths = basis.project(phase, weights) / deviation
    chosen = torch.empty_like(keep)
    for i in range(len(y)):
        seen = observed[i][:, used]
        values = torch.where(seen, y[i][:, used], 0) / deviation
        theirs = paths if among is None else paths[:, among[i]]
        squares = (torch.where(seen.unsqueeze(1), theirs - values.unsqueeze(1), 0)).square().sum(-1)
        found = squares.cumsum(0)[keep[i]].argmin(-1)
        chosen[i] = found if among is None else among[i][found]
    return chosen
