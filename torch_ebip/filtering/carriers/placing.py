"""Leading members back where a `Pace` has them, before they take in a sample: for both carriers."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torch_ebip.filtering.carriers.columns import ColumnMembers
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.states import EnsembleState
from torch_ebip.filtering.updates.pace import Pace, Placement, led
from torch_ebip.filtering.updates.weighting import Seen


def placed(
    pace: Pace,
    model: StateSpace,
    state: EnsembleState,
    y: Tensor,
    observed: Tensor,
    first: Callable[[EnsembleState], Tensor | None],
) -> EnsembleState:
    """A state whose members are where a pace leads them, now that a sample was seen.

    Args:
        pace: of the update.
        model: of the members.
        state: not changed.
        y: [..., D], units of the DoFs.
        observed: bool [..., D], something of it True.
        first: says how members started, [..., E, n]; None where nobody knows.
    """
    members = state.deviations
    moving, still = model.split(members)
    mean = model.mean(moving, state.weights)
    seen = Seen(y, observed, None, None, moving, mean, state.memory.origin)
    memory, placement = pace.notice(state.memory.pace, seen)
    if placement is not None:
        start = first(state) if bool((placement.renewed > 0).any()) else None
        if start is not None:
            start = start if state.centre is None else start - state.centre.unsqueeze(-2)
            still = torch.lerp(still, start[..., moving.shape[-1] :], placement.renewed[..., None, None])
        first_entry = led(moving[..., 0], mean[..., 0], placement).unsqueeze(-1)
        members = torch.cat([first_entry, moving[..., 1:], still], -1)
    return EnsembleState(members, state.memory._replace(pace=memory), state.centre)


def place_columns(columns: ColumnMembers, mean: Tensor, placement: Placement) -> None:
    """Lead members that are columns, whose moving entries have a mean [..., m]; what stands still is renewed."""
    entry = columns.moving.select(-2, 0)
    entry.copy_(led(entry, mean.select(-1, 0), placement))
    if bool((placement.renewed > 0).any()):
        columns.renew(placement.renewed)
