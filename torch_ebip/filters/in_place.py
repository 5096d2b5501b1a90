"""A whole sequence by the live path: what `EnsembleFilter` does where no gradients are asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torch_ebip.draws import Generators
from torch_ebip.filters.base import Trace
from torch_ebip.filters.live import LiveFilter
from torch_ebip.filters.members import EnsembleState
from torch_ebip.filters.sequence import State, assemble

if TYPE_CHECKING:
    from torch_ebip.filters.ensemble import EnsembleFilter


def filter_in_place(
    filter: EnsembleFilter,
    y: Tensor,
    observed: Tensor,
    dt: float,
    state: EnsembleState,
    generator: Generators,
    keep: Tensor | None,
    project: bool,
) -> Trace:
    """`Filter.forward` for sequences y [T, D] or [B, T, D] that were checked; the same numbers up to rounding."""
    batch, length = y.shape[:-2], y.shape[-2]
    ever = observed.reshape(-1, filter.n_dofs).any(0)
    everything = (True,) * filter.n_dofs
    # The projection is one of all DoFs; otherwise what is never measured can stay behind the transform.
    dofs = None if project or not bool(ever.any()) else ever
    live = LiveFilter(filter, dofs, tuple(batch), generator=generator, state=state)
    some = observed.reshape(-1, length, filter.n_dofs).any(0)
    ragged = (observed != some).any(-1).reshape(-1, length).any(0).tolist()
    phases, likelihoods, projections = [], [], []
    kept: list[tuple[tuple[int, ...], State]] = []
    for t, measured in enumerate(some.tolist()):
        if t:
            live.predict(dt)
        mask = observed[..., t, :] if ragged[t] else None
        likelihoods.append(live.take(y[..., t, :], tuple(measured), mask))
        phases.append(live.phase)
        projections.append(live.project(everything) if project else y.new_zeros(*batch, 0))
        if keep is not None:
            for place in (keep == t).nonzero().tolist():
                kept.append((tuple(place), live.entry(place[0] if batch else None)))
    return Trace(
        live.state,
        torch.stack(phases, -1),
        torch.stack(likelihoods, -1),
        torch.stack(projections, -2),
        None if keep is None else assemble(kept, keep.shape),
    )
