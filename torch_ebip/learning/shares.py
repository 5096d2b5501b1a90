"""How much each of several voices should count in a forecast, by horizon: least squares, held to what can be shown.

Voices are forecasts less the training mean; a share is of that way. What interactions left out cannot show to beat
the mean counts less: shares are multiplied by a trust that grows with the standard errors of their gain over
interactions, from none below `DOUBT` to all of it above `CERTAIN`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.learning.metrics import Z95

SWEEPS = 200
"""Of coordinate descent on a handful of shares, at most; it ends when none changes by `CLOSE`."""
CLOSE = 1e-7
DOUBT, CERTAIN = 1.5, 4.0
"""Standard errors of a gain below which it counts for nothing, and above which it counts for all of it."""
FEWEST = 50
"""Forecasts that decide about a deviation, at least."""
FACTORS = (0.3, 5.0)
"""Between which deviations are stretched."""
ROUNDS = 4
"""Of reweighting, where single interactions are not to decide."""


def best_shares(
    voices: Tensor, place: Tensor, wanted: Tensor, fold: Tensor, folds: int, pull: float, robust: bool = False
) -> tuple[Tensor, Tensor]:
    """Shares [S, V] of V voices at S horizons in [0, 1], and those learned without each of F folds, [F, S, V].

    Args:
        voices: [R, K, P, D, V], forecasts less the mean, of one modality, units of its spread.
        place: [R, K, P, S], see `horizon_hats`.
        wanted: [R, K, P, D], truth less the mean, in the same units; NaN: not measured.
        fold: int64 [R].
        folds: F.
        pull: towards 1, or an equal part of it where there are several voices, as a share of what voices vary.
        robust: whether errors beyond one spread count less, as in pseudo-Huber's loss.
    """
    S, V = place.shape[-1], voices.shape[-1]
    measured = ~wanted.isnan()
    towards = 1.0 if not robust else 1 / V
    rows = []
    for f in range(folds):
        ours = fold == f
        basis = (place[ours][..., None, :, None] * voices[ours].unsqueeze(-2))[measured[ours]].flatten(-2)
        rows.append((basis.double(), wanted[ours][measured[ours]].double()))
    several = [torch.ones_like(each[1]) for each in rows]
    whole: list[Tensor] = []
    without: list[Tensor] = []
    zero = voices.new_zeros((), dtype=torch.double)
    for left_out in (None, *range(folds)):
        weights, share = several, voices.new_zeros(S * V)
        for _ in range(ROUNDS if robust else 1):
            used = [f for f in range(folds) if f != left_out]
            gram = sum(((rows[f][0] * weights[f].unsqueeze(-1)).T @ rows[f][0] for f in used), zero)
            moment = sum((rows[f][0].T @ (weights[f] * rows[f][1]) for f in used), zero)
            share = within(gram, moment, pull, towards)
            if robust:
                weights = [(1 + (y - basis @ share).square()).rsqrt() for basis, y in rows]
        (whole if left_out is None else without).append(share.to(voices).view(S, V))
    return whole[0], torch.stack(without)


def within(gram: Tensor, moment: Tensor, pull: float, towards: float = 1.0) -> Tensor:
    """Shares [J] in [0, 1] that minimise s' G s - 2 s' m, by coordinate descent.

    Args:
        gram: G, [J, J].
        moment: m, [J].
        pull: weight of the distance from ``towards``, as a share of the mean of the diagonal.
        towards: a share.
    """
    ridge = pull * gram.diagonal().mean() + 1e-12
    gram = gram + ridge * torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
    moment = moment + ridge * towards
    rows, goals, share = gram.tolist(), moment.tolist(), [towards] * len(moment)
    for _ in range(SWEEPS):
        before = list(share)
        for k, row in enumerate(rows):
            rest = goals[k] - sum(g * s for g, s in zip(row, share, strict=True)) + row[k] * share[k]
            share[k] = min(max(rest / row[k], 0.0), 1.0)
        if max(abs(a - b) for a, b in zip(share, before, strict=True)) < CLOSE:
            break
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
        if bool((weight.expand_as(wanted)[~wanted.isnan()] > 0).any()):
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
    each = (sums[0] / sums[1].clamp(min=1e-9))[sums[1] > 0]
    if len(each) < 2:
        return 0.0
    return float(each.mean() / (each.std() / len(each) ** 0.5).clamp(min=1e-12))


def widening(miss: Tensor, place: Tensor, fold: Tensor) -> tuple[Tensor, Tensor]:
    """Factors [S] on deviations so that 95 % lie within 1.96 of them; [R, S] without its own fold.

    Args:
        miss: [R, K, P, D], absolute errors in deviations; NaN: not measured.
        place: [R, K, P, S], see `horizon_hats`.
        fold: int64 [R].
    """
    S = place.shape[-1]
    # Where a horizon lies between two of those that are learned it says something of both.
    near = place > 0.4

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
