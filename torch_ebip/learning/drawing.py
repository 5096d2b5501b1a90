"""How far forecasts are drawn towards the training mean, and how wide they should be: from interactions left out.

What validation cannot show to beat the mean is drawn towards it, by horizon and by target: the best share by least
squares, times a trust that grows with the standard errors of its gain over interactions, from none below
`DOUBT` to all of it above `CERTAIN`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.horizons import LEVELS, HorizonShrinkage
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.metrics import Z95
from torch_ebip.learning.said import Said, what_it_says
from torch_ebip.learning.stages import Scores, scores_of, tally

SWEEPS = 200
"""Of coordinate descent on a handful of shares."""
DOUBT, CERTAIN = 1.5, 4.0
"""Standard errors of a gain below which it counts for nothing, and above which it counts for all of it."""
FEWEST = 50
"""Forecasts that decide about a deviation, at least."""
FACTORS = (0.3, 5.0)
"""Between which deviations are stretched."""


class Drawn(NamedTuple):
    """What was found.

    Attributes:
        readout: to be given to the filter.
        shares: of each target modality, the mean share by horizon.
        scores: after it; each interaction drawn by what was learned without its fold.
        gain: by horizon, by how many standard errors the squared error is then less than the training mean's, pair by
            pair.
        gain_alone: the same of the filter alone.
    """

    readout: HorizonShrinkage
    shares: dict[str, dict[str, float]]
    scores: Scores
    gain: dict[str, float]
    gain_alone: dict[str, float]


@without_autocast
@torch.no_grad()
def learn_drawing(held_out: HeldOut, filter: InteractionFilter, interactions: Tensor, scored: Tensor) -> Drawn:
    """What a filter's forecasts should pass through.

    With few interactions the shares are pulled towards 1, where the filter speaks alone, before their gain is asked.

    Args:
        held_out: the demonstrations, and what is asked of them: seconds ahead.
        filter: whose forecasts are drawn; without a read-out.
        interactions: int64 [B], that decide.
        scored: int64 [S], those among them whose scores are told.
    """
    task = held_out.task
    layout, objective = task.primitive.layout, task.objective
    names, ahead = objective.horizons, objective.ahead
    assert names is not None
    assert ahead is not None
    said = what_it_says(held_out, filter, interactions)
    device = said.towards.device
    fold = held_out.partition.fold_of.to(device)[said.interaction]
    modality = layout.modality_of_dof.to(device)[task.targets]
    S, J, D = said.place.shape[-1], len(LEVELS), layout.n_dofs
    share, widening = said.own.new_ones(D, S, J), said.own.new_ones(D, S)
    drawn, deviation = torch.zeros_like(said.towards), torch.zeros_like(said.towards)
    shares: dict[str, dict[str, float]] = {}
    everywhere = layout.modality_of_dof.to(device)
    for m in sorted(set(modality.tolist())):
        ours, here = modality == m, (everywhere == m) & task.targets
        part = _of(said, ours)
        best, without = _best_shares(part, fold, held_out.settings.folds, 2 / len(interactions))
        trust = _trust(part, without, fold)
        mine = _at(part, without * trust.unsqueeze(-1), fold)
        share[here] = best * trust.unsqueeze(-1)
        width = (1 - mine) * part.demonstrated + mine * part.own
        whole, left_out = _widening(part, mine, width, fold)
        widening[here] = whole
        drawn[..., ours] = mine * part.towards
        deviation[..., ours] = width * torch.einsum("rkps,rs->rkp", part.place, left_out).unsqueeze(-1)
        shares[layout.names[m]] = {name: round(float(mine[:, :, p].mean()), 4) for p, name in enumerate(names)}
    told = torch.isin(said.interaction, scored.to(device))
    scale = objective.scale
    after = tally(held_out, (drawn - said.wanted)[told] * scale, deviation[told] * scale)
    gains = [{name: _gain(said, other, p, told) for p, name in enumerate(names)} for other in (drawn, said.towards)]
    return Drawn(HorizonShrinkage(share, widening, ahead.tolist()), shares, scores_of(after), *gains)


def _of(said: Said, ours: Tensor) -> Said:
    """Of some of the targets, bool [D]."""
    towards, wanted, own, apart, level = (tensor[:, :, :, ours] for tensor in said[1:6])
    mean = said.mean[:, :, :, ours]
    return Said(said.interaction, towards, wanted, own, apart, level, said.place, mean, said.doubt)


def _best_shares(part: Said, fold: Tensor, folds: int, pull: float) -> tuple[Tensor, Tensor]:
    """Shares [S, J] of one modality, and those learned without each fold [F, S, J]."""
    measured = ~part.wanted.isnan()
    S, J = part.place.shape[-1], part.level.shape[-1]
    gram, moment = part.own.new_zeros(folds, S * J, S * J).double(), part.own.new_zeros(folds, S * J).double()
    for f in range(folds):
        rows = fold == f
        basis = part.place[rows].unsqueeze(-2).unsqueeze(-1) * part.level[rows].unsqueeze(-2)  # [R, K, P, D, S, J]
        basis = (basis * part.towards[rows][..., None, None])[measured[rows]].flatten(-2).double()
        gram[f], moment[f] = basis.T @ basis, basis.T @ part.wanted[rows][measured[rows]].double()
    best = _within(gram.sum(0), moment.sum(0), pull).to(part.own).view(S, J)
    without = [_within(gram.sum(0) - gram[f], moment.sum(0) - moment[f], pull) for f in range(folds)]
    return best, torch.stack(without).to(part.own).view(folds, S, J)


def _at(part: Said, shares: Tensor, fold: Tensor) -> Tensor:
    """[R, K, P, D]: each forecast's share, by what is learned without its fold, [F, S, J]."""
    return torch.einsum("rkps,rsj,rkpdj->rkpd", part.place, shares[fold], part.level)


def _trust(part: Said, without: Tensor, fold: Tensor) -> Tensor:
    """[S], 0 to 1, by the standard errors of what shares [F, S, J] gain on the mean."""
    drawn = _at(part, without, fold) * part.towards
    trust = part.own.new_ones(part.place.shape[-1])
    for s in range(len(trust)):
        weight = part.place[..., s].unsqueeze(-1)
        if bool((weight.expand_as(part.wanted)[~part.wanted.isnan()] > 0).any()):
            z = _standard_errors(part.interaction, part.wanted, drawn, weight)
            trust[s] = min(max((z - DOUBT) / (CERTAIN - DOUBT), 0.0), 1.0)
    return trust


def _gain(said: Said, drawn: Tensor, p: int, told: Tensor) -> float:
    """Standard errors of the gain on the mean of forecasts ``drawn`` [R, K, P, D] at horizon p."""
    return _standard_errors(said.interaction[told], said.wanted[told, :, p : p + 1], drawn[told, :, p : p + 1], None)


def _standard_errors(interaction: Tensor, wanted: Tensor, drawn: Tensor, weight: Tensor | None) -> float:
    """The mean over interactions of squared errors of 0 less those of ``drawn`` [R, K, P, D], in standard errors."""
    measured = (~wanted.isnan()).to(drawn)
    weight = measured if weight is None else measured * weight
    wanted = wanted.nan_to_num()
    gain = (wanted.square() - (wanted - drawn).square()) * weight
    # Interactions are what is independent, not the moments of one, nor the sets of sensors that it was shown with.
    sums = gain.new_zeros(2, int(interaction.max()) + 1)
    sums[0].index_add_(0, interaction, gain.sum((1, 2, 3)))
    sums[1].index_add_(0, interaction, weight.sum((1, 2, 3)))
    each = (sums[0] / sums[1].clamp(min=1e-9))[sums[1] > 0]
    if len(each) < 2:
        return 0.0
    return float(each.mean() / (each.std() / len(each) ** 0.5).clamp(min=1e-12))


def _widening(part: Said, share: Tensor, width: Tensor, fold: Tensor) -> tuple[Tensor, Tensor]:
    """Factors [S] on deviations [R, K, P, D] so that 95 % lie within 1.96 of them; [R, S] without its own fold."""
    miss = (part.wanted - share * part.towards).abs() / width.clamp(min=1e-12)
    S = part.place.shape[-1]
    # Where a horizon lies between two of those that are learned it says something of both.
    near = part.place > 0.4

    def factors(rows: Tensor) -> Tensor:
        """Of some of the forecasts."""
        found = width.new_ones(S)
        for s in range(S):
            values = miss[rows][near[rows][..., s]]
            values = values[~values.isnan()]
            if len(values) >= FEWEST:
                found[s] = float(values.quantile(0.95)) / Z95
        return found.clamp(*FACTORS)

    each = width.new_ones(len(fold), S)
    for f in sorted(set(fold.tolist())):
        each[fold == f] = factors(fold != f)
    return factors(torch.ones_like(fold, dtype=torch.bool)), each


def _within(gram: Tensor, moment: Tensor, pull: float) -> Tensor:
    """Shares [J] in [0, 1] that minimise s' G s - 2 s' m, pulled towards 1, by coordinate descent."""
    ridge = pull * gram.diagonal().mean() + 1e-12
    gram = gram + ridge * torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
    moment = moment + ridge
    share = torch.ones_like(moment)
    for _ in range(SWEEPS):
        for k in range(len(share)):
            rest = moment[k] - gram[k] @ share + gram[k, k] * share[k]
            share[k] = (rest / gram[k, k]).clamp(0, 1)
    return share
