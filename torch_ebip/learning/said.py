"""What a filter says of interactions that it does not know, beside the training mean and the truth."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.filtering.states import map_state
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.horizons import LEVELS, horizon_hats, level_hats
from torch_ebip.interaction.present import Present
from torch_ebip.interaction.readout import widths_of
from torch_ebip.learning.held_out import HeldOut, Shown
from torch_ebip.learning.references import paths_after


class Said(NamedTuple):
    """What a filter said of interactions it did not know: R of them, K moments, P horizons, D targets.

    Attributes:
        interaction: int64 [R].
        towards: [R, K, P, D], forecast less the mean, units of the scale.
        wanted: [R, K, P, D], truth less the mean; NaN: not measured.
        own, demonstrated: [R, K, P, D], deviations of the forecast and of the demonstrations, units of the scale.
        level: [R, K, P, D, J], see `level_hats`.
        place: [R, K, P, S], see `horizon_hats`.
        mean: [R, K, P, D], of the demonstrations, units of the scale.
        doubt: [R, K], how surprised the filter was, see `InteractionSurprise.doubt`; 0 if it never is.
        present: [R, K], what it knew of the present; None where it remembers nothing of late.
        counted: bool [K], the moments that scores are of, which are within the settings' horizons; None: all.
        usual: [R, K, P, D], on a circle the training mean at the same time since the beginning, less ``mean``, which
            is at the filter's phase; None: the two are taken for the same.
    """

    interaction: Tensor
    towards: Tensor
    wanted: Tensor
    own: Tensor
    demonstrated: Tensor
    level: Tensor
    place: Tensor
    mean: Tensor
    doubt: Tensor
    present: Present | None = None
    counted: Tensor | None = None
    usual: Tensor | None = None

    def __repr__(self) -> str:
        return brief(self)


def what_it_says(
    held_out: HeldOut, filter: InteractionFilter, interactions: Tensor, shares: Tensor | None = None
) -> Said:
    """What a filter says of interactions, with every set of sensors; of all processes together.

    Args:
        held_out: the demonstrations, and what is asked of them.
        filter: over all DoFs.
        interactions: int64 [B].
        shares: [K], up to which parts of their length they are shown; default: see `HeldOut.shares`.
    """
    task = held_out.task
    primitive, targets, objective = task.primitive, task.targets, task.objective
    scale, ahead = objective.scale, objective.ahead
    seconds = scale.new_tensor([math.inf]) if ahead is None else ahead
    parts: list[Said] = []
    for subset in task.subsets.values():
        for trial in held_out.trials(filter, interactions, subset, shares):
            shown, state = trial.shown, trial.trace.kept
            forecast = trial.forecast(objective)
            lead = trial.filter.lead(state, forecast.phase, ahead)
            weights = primitive.weights[shown.members].mean(1)[:, None, None, :]
            mean = primitive.basis.project(lead.phase, weights)[..., targets]
            _, variance = trial.filter.demonstrated(lead.phase)
            widths = widths_of(forecast, variance[..., shown.targets])
            level = level_hats(widths, scale.new_tensor(LEVELS))
            place = horizon_hats(lead, seconds)
            values = (forecast.mean - mean, shown.truth - mean, widths.own, widths.demonstrated)
            towards, wanted, own, apart = (value / scale for value in values)
            parts.append(
                Said(
                    shown.interactions,
                    towards,
                    wanted,
                    own,
                    apart,
                    level,
                    place,
                    mean / scale,
                    trial.filter.doubted(state),
                    None if filter.recent is None else trial.filter.present(state),
                    None,
                    _usual(held_out, shown, mean),
                )
            )
    gathered = held_out.ranks.gather([map_state(Tensor.cpu, part) for part in parts])
    together = [part for share in gathered for part in share]
    device = primitive.weights.device
    found: Said = map_state(lambda *tensors: torch.cat(tensors).to(device), *together)
    low = held_out.settings.horizons[0]
    return found if shares is None else found._replace(counted=(shares >= low - 1e-6).to(device))


def _usual(held_out: HeldOut, shown: Shown, mean: Tensor) -> Tensor | None:
    """See `Said.usual`; the mean in units of the DoFs."""
    task, ahead = held_out.task, held_out.task.objective.ahead
    if not task.primitive.periodic or ahead is None:
        return None
    dt = held_out.settings.thinning / task.primitive.rate
    time = (shown.steps * dt).to(mean).unsqueeze(-1) + ahead
    among = shown.members[:, None, None, :].expand(*time.shape, -1)
    paths = paths_after(task.primitive, time.unsqueeze(-1), among, task.targets)
    return (paths.mean(-2) - mean) / task.objective.scale
