"""Forecasts along a recording, sample by sample, as a robot would have had them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from torch_ebip.common.ambient import in_own_modes
from torch_ebip.common.arguments import as_values
from torch_ebip.common.draws import seeded
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.recordings.layout import Layout

PORTION = 1 << 28
"""Bytes of the states that are kept at once."""


@in_own_modes
@torch.no_grad()
def forecast_recorded(
    filter: InteractionFilter, layout: Layout, values: Any, ahead: Sequence[float], seed: int
) -> Forecast:
    """See `InteractionModel.forecast`.

    Args:
        filter: over all DoFs of the layout.
        layout: whose controlled DoFs are not looked at.
        values: [T, D], units of the DoFs; NaN: not measured.
        ahead: A times in seconds after each sample; infinity: the end.
        seed: of the filter's draws.
    """
    like = next(filter.parameters())
    y = as_values("values", values, layout.dofs, None if isinstance(values, torch.Tensor) else like).to(like)
    if y.ndim != 2 or y.shape[1] != layout.n_dofs or len(y) == 0:
        raise ValueError(
            f"values must be [T, {layout.n_dofs}], one column for each of {', '.join(layout.dofs[:8])}, "
            f"got {list(y.shape)}; `InteractionModel.prepare` gives recordings the model's columns"
        )
    y = layout.continuous(y)
    ahead = [ahead] if isinstance(ahead, int | float) else list(ahead)
    if len(ahead) == 0:
        raise ValueError("ahead must be at least one number of seconds")
    observed = ~y.isnan() & ~layout.controlled.to(y.device)
    y, generator, state = torch.where(observed, y, torch.nan), seeded(seed), None
    size = filter.initial_state(generator=seeded(seed))[0].numel() * like.element_size() * len(ahead)
    portion = max(1, PORTION // size)
    means, variances, phases = [], [], []
    labels: dict[str, list[torch.Tensor]] = {}
    for some, seen in zip(torch.split(y, portion), torch.split(observed, portion), strict=True):
        if state is not None:
            state = filter.predict(state, filter.dt, generator)
        every = torch.arange(len(some), device=y.device)
        trace = filter(some, seen, state=state, generator=generator, keep=every, project=False)
        state = trace.state
        said = filter.forecast(trace.kept, ahead=ahead)
        means.append(said.mean)
        variances.append(said.variance)
        phases.append(said.phase)
        # A filter that does not weigh its members cannot say, and is not asked: its forecasts are as good.
        memory = getattr(trace.kept, "memory", None)
        if filter.recognition is not None and memory is not None and memory.weighting is not None:
            for label, probability in filter.recognise(trace.kept).items():
                labels.setdefault(label, []).append(probability)
    together = {label: torch.cat(parts) for label, parts in labels.items()} or None
    return Forecast(torch.cat(means), torch.cat(variances), torch.cat(phases), labels=together)
