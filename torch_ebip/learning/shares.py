"""How much each of several voices should count in a forecast, by horizon: least squares, held to what can be shown.

Voices are forecasts less the training mean; a share is of that way. What interactions left out cannot show to beat
the mean counts less: shares are multiplied by a trust that grows with the standard errors of their gain over
interactions, from none below `DOUBT` to all of it above `CERTAIN`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.learning.metrics import Z95

NEXT_TO_NOTHING = 1e-3
"""Weight, in moments, up to which an interaction says nothing of a horizon: it came near it by rounding."""
SWEEPS = 200
"""Of coordinate descent on a handful of shares."""
DOUBT, CERTAIN = 1.5, 4.0
"""Standard errors of a gain below which it counts for nothing, and above which it counts for all of it."""
FEWEST = 50
"""Forecasts that decide about a deviation, at least."""
NEAR = 0.4
"""Weight of a horizon, or of a level, from which on what was said is said of it."""
FACTORS = (0.3, 5.0)
"""Between which deviations are stretched."""


def best_shares(
    voices: Tensor, place: Tensor, wanted: Tensor, fold: Tensor, folds: int, pull: float
) -> tuple[Tensor, Tensor]:
    """Shares [S, V] of V voices at S horizons in [0, 1], and those learned without each of F folds, [F, S, V].

    Args:
        voices: [R, K, P, D, V], forecasts less the mean, of one modality, units of its spread.
        place: [R, K, P, S], see `horizon_hats`.
        wanted: [R, K, P, D], truth less the mean, in the same units; NaN: not measured.
        fold: int64 [R].
        folds: F.
        pull: towards 1, as a share of what voices vary.
    """
    S, V = place.shape[-1], voices.shape[-1]
    measured = ~wanted.isnan()
    grams, moments = [], []
    for f in range(folds):
        ours = fold == f
        basis = (place[ours][..., None, :, None] * voices[ours].unsqueeze(-2))[measured[ours]].flatten(-2).double()
        grams.append(basis.T @ basis)
        moments.append(basis.T @ wanted[ours][measured[ours]].double())
    gram, moment = torch.stack(grams), torch.stack(moments)
    best = within(gram.sum(0), moment.sum(0), pull).to(voices).view(S, V)
    without = [within(gram.sum(0) - gram[f], moment.sum(0) - moment[f], pull) for f in range(folds)]
    return best, torch.stack(without).to(voices).view(folds, S, V)


def within(gram: Tensor, moment: Tensor, pull: float) -> Tensor:
    """Shares [J] in [0, 1] that minimise s' G s - 2 s' m, pulled towards 1, by coordinate descent.

    Args:
        gram: G, [J, J].
        moment: m, [J].
        pull: weight of the distance from 1, as a share of the mean of the diagonal.
    """
    ridge = pull * gram.diagonal().mean() + 1e-12
    gram = gram + ridge * torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
    moment = moment + ridge
    rows, goals, share = gram.tolist(), moment.tolist(), [1.0] * len(moment)
    for _ in range(SWEEPS):
        for k, row in enumerate(rows):
            rest = goals[k] - sum(g * s for g, s in zip(row, share, strict=True)) + row[k] * share[k]
            share[k] = min(max(rest / row[k], 0.0), 1.0)
    return moment.new_tensor(share)


def trust(interaction: Tensor, wanted: Tensor, drawn: Tensor, place: Tensor) -> Tensor:
    """[S], 0 to 1, by the standard errors of what forecasts gain on the mean at each of S horizons.

    Args:
        interaction: int64 [R].
        wanted, drawn: [R, K, P, D], truth and forecast less the mean.
        place: [R, K, P, S], see `horizon_hats`.
    """
    found = drawn.new_ones(place.shape[-1])
    for s in range(len(found)):
        weight = place[..., s].unsqueeze(-1)
        if bool((weight.expand_as(wanted)[~wanted.isnan()] > NEXT_TO_NOTHING).any()):
            z = standard_errors(interaction, wanted, drawn, weight)
            found[s] = min(max((z - DOUBT) / (CERTAIN - DOUBT), 0.0), 1.0)
    return found


def standard_errors(interaction: Tensor, wanted: Tensor, drawn: Tensor, weight: Tensor | None = None) -> float:
    """The mean over interactions of squared errors of 0 less those of forecasts, in standard errors.

    Args:
        interaction: int64 [R].
        wanted, drawn: [R, K, P, D], truth and forecast less the mean.
        weight: [R, K, P, 1], of each; default: all alike.
    """
    measured = (~wanted.isnan()).to(drawn)
    weight = measured if weight is None else measured * weight
    wanted = wanted.nan_to_num()
    gain = (wanted.square() - (wanted - drawn).square()) * weight
    # Interactions are what is independent, not the moments of one, nor the sets of sensors that it was shown with.
    sums = gain.new_zeros(2, int(interaction.max()) + 1)
    sums[0].index_add_(0, interaction, gain.sum((1, 2, 3)))
    sums[1].index_add_(0, interaction, weight.sum((1, 2, 3)))
    each = (sums[0] / sums[1].clamp(min=1e-9))[sums[1] > NEXT_TO_NOTHING]
    if len(each) < 2:
        return 0.0
    return float(each.mean() / (each.std() / len(each) ** 0.5).clamp(min=1e-12))


def stretching(miss: Tensor, place: Tensor, level: Tensor, fold: Tensor) -> tuple[Tensor, Tensor]:
    """`widening` for each of J levels of how little a filter knows: factors [S, J], and [R, S, J] without each fold.

    A level of which too little was seen has the factor of the one below it, or 1 where that is less: who knows less
    does not err less.

    Args:
        miss: [R, K, P, D], absolute errors in deviations; NaN: not measured.
        place: [R, K, P, S], see `horizon_hats`.
        level: [R, K, P, D, J], see `level_hats`.
        fold: int64 [R].
    """
    whole = miss.new_ones(place.shape[-1], level.shape[-1])
    each = miss.new_ones(len(fold), place.shape[-1], level.shape[-1])
    before = torch.zeros_like(whole[:, 0]), torch.zeros_like(each[..., 0])
    for j in range(level.shape[-1]):
        there = level[..., j] > NEAR
        found = widening(torch.where(there, miss, torch.nan), place, fold)
        enough = torch.stack(
            [(there & (place[..., s : s + 1] > NEAR) & ~miss.isnan()).sum() for s in range(len(whole))]
        )
        few = enough < 2 * FEWEST  # one of the folds may have none of them
        for values, now, least in zip((whole, each), found, before, strict=True):
            values[..., j] = torch.where(few, least.clamp(min=1), now)
        before = whole[:, j], each[..., j]
    return whole, each


def widening(miss: Tensor, place: Tensor, fold: Tensor) -> tuple[Tensor, Tensor]:
    """Factors [S] on deviations so that 95 % lie within 1.96 of them; [R, S] without its own fold.

    Args:
        miss: [R, K, P, D], absolute errors in deviations; NaN: not measured.
        place: [R, K, P, S], see `horizon_hats`.
        fold: int64 [R].
    """
    S = place.shape[-1]
    # Where a horizon lies between two of those that are learned it says something of both.
    near = place > NEAR

    def factors(rows: Tensor) -> Tensor:
        """Of some of the forecasts."""
        found = miss.new_ones(S)
        for s in range(S):
            values = miss[rows][near[rows][..., s]]
            values = values[~values.isnan()]
            if len(values) >= FEWEST:
                found[s] = float(values.quantile(0.95)) / Z95
        return found.clamp(*FACTORS)

    each = miss.new_ones(len(fold), S)
    for f in sorted(set(fold.tolist())):
        each[fold == f] = factors(fold != f)
    return factors(torch.ones_like(fold, dtype=torch.bool)), each
