"""A whole sequence by the span carrier: what `EnsembleFilter` does where no gradients are recorded."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.common.draws import Generators
from torch_ebip.filtering.carriers.span import SpanCarrier
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.sequence import Filtered, along, assemble
from torch_ebip.filtering.states import EnsembleState, State
from torch_ebip.filtering.updates.update import Update


def filter_in_place(
    model: StateSpace,
    update: Update,
    y: Tensor,
    observed: Tensor,
    dt: float,
    state: EnsembleState,
    generator: Generators,
    keep: Tensor | None,
    project: bool,
    first: Tensor | None = None,
) -> Filtered:
    """`Filter.forward` for sequences y [T, D] or [B, T, D] that were checked; the same numbers up to rounding.

    Args:
        model, update: that the carrier can serve.
        y: [..., T, D].
        observed: bool [..., T, D].
        dt: seconds between samples.
        state: where to start.
        generator: of all draws.
        keep: int64 [..., K], after which samples to keep the state.
        project: whether to project.
        first: see `SpanCarrier`.

    Returns:
        See `Filtered`: states [..., T, m], log-likelihood [..., T], projection [..., T, D].
    """
    batch, length, D = y.shape[:-2], y.shape[-2], y.shape[-1]
    ever = observed.reshape(-1, D).any(0)
    everything = (True,) * D
    # The projection is one of all DoFs; otherwise what is never measured can stay behind the transform.
    sensors = torch.ones_like(ever) if project or not bool(ever.any()) else ever
    carrier = SpanCarrier(model, update, sensors, state, generator, first)
    some = observed.reshape(-1, length, D).any(0)
    ragged = (observed != some).any(-1).reshape(-1, length).any(0).tolist()
    states, likelihoods, projections, felt = [], [], [], []
    kept: list[tuple[tuple[int, ...], State]] = []
    for t, measured in enumerate(some.tolist()):
        if t:
            carrier.predict(dt)
        mask = observed[..., t, :] if ragged[t] else None
        likelihoods.append(carrier.take(y[..., t, :], tuple(measured), mask))
        states.append(carrier.mean)
        projections.append(carrier.project(everything) if project else y.new_zeros(*batch, 0))
        if carrier.memory.surprise is not None:
            felt.append(carrier.memory.surprise)
        if keep is not None:
            for place in (keep == t).nonzero().tolist():
                kept.append((tuple(place), carrier.state(entry=place[0] if batch else None)))
    return Filtered(
        carrier.state(),
        torch.stack(states, -2),
        torch.stack(likelihoods, -1),
        torch.stack(projections, -2),
        None if keep is None else assemble(kept, keep.shape),
        along(felt, batch),
    )
