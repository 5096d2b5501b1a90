"""How two voices are put together, by ridge regression, and how wide that is; each choice by what folds say."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.filtering.functional.scores import gaussian_crps
from torch_ebip.learning.shares import widening

PULLS = (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Towards analogues alone, that are tried; in moments."""
FIXED = (100.0, 1e4, 1e8)
"""Against a correction by the mean, that are tried: the last allows none."""
QUARTERS = tuple(q for q in product(range(5), repeat=3) if sum(q) == 4)
"""Of three deviations, that are tried."""


class Correction(NamedTuple):
    """A matrix for each of S horizons, of n DoFs.

    Attributes:
        whole: [S, n, m], from all moments.
        left_out: [R, K, P, n], what it comes to, each moment by what is learned without its fold.
    """

    whole: Tensor
    left_out: Tensor

    def __repr__(self) -> str:
        return brief(self)


def best_correction(voices: Tensor, place: Tensor, wanted: Tensor, fold: Tensor, folds: int) -> Correction:
    """What of some voices should be added to a forecast, by ridge regression.

    Args:
        voices: [R, K, P, m]: m - n that may be followed, and n that are pulled to nothing by a strength of their own.
        place: [R, K, P, S], see `horizon_hats`.
        wanted: [R, K, P, n], what is missing; NaN: not measured.
        fold: int64 [R].
        folds: F, of which each strength is judged.
    """
    width = voices.shape[-1]
    S, n = place.shape[-1], wanted.shape[-1]
    design = (place.unsqueeze(-1) * voices.unsqueeze(-2)).flatten(-2)  # [R, K, P, S m]
    measured = ~wanted.isnan().any(-1)
    grams, moments = [], []
    for f in range(folds):
        rows = measured & (fold == f).view(-1, 1, 1)
        a, y = design[rows].double(), wanted[rows].double()
        grams.append(a.T @ a)
        moments.append(a.T @ y)
    gram, moment = torch.stack(grams), torch.stack(moments)
    which = torch.arange(width, device=voices.device).repeat(S) < width - n
    best: tuple[float, Tensor, Tensor] | None = None
    for pull, fixed in product(PULLS, FIXED):
        ridge = torch.diag(torch.where(which, pull, fixed).double())
        without = torch.linalg.solve(gram.sum(0) - gram + ridge, moment.sum(0) - moment).to(voices)
        left_out = torch.zeros_like(wanted)
        for f in range(folds):
            left_out[fold == f] = design[fold == f] @ without[f]
        loss = float(((1 + (wanted - left_out).square()).sqrt() - 1)[measured].mean())
        if best is None or loss < best[0]:
            best = loss, torch.linalg.solve(gram.sum(0) + ridge, moment.sum(0)).to(voices), left_out
    assert best is not None
    return Correction(best[1].view(S, width, n).transpose(-1, -2), best[2])


def best_width(deviations: Tensor, place: Tensor, error: Tensor, fold: Tensor, folds: int) -> tuple[Tensor, Tensor]:
    """How much each of three deviations counts, [S, 1, 3], by CRPS; and what that comes to, [R, K, P, n], left out.

    Args:
        deviations: [R, K, P, n, 3].
        place: [R, K, P, S], see `horizon_hats`.
        error: [R, K, P, n]; NaN: not measured.
        fold: int64 [R].
        folds: F.
    """
    S = place.shape[-1]
    tried = []
    for quarters in QUARTERS:
        share = deviations.new_tensor(quarters) / 4
        width = (deviations @ share).clamp(min=1e-12)
        whole, each = widening(error.abs() / width, place, fold)
        left_out = width * torch.einsum("rkps,rs->rkp", place, each).unsqueeze(-1)
        score = gaussian_crps(error, left_out.square(), torch.zeros_like(error))
        tried.append((score, share * whole.unsqueeze(-1), left_out))
    widths, left_out = deviations.new_zeros(S, 3), torch.zeros_like(error)
    for s in range(S):
        near = place[..., s].unsqueeze(-1)
        scores = [float((score * near).nansum()) for score, _, _ in tried]
        best = tried[min(range(len(tried)), key=scores.__getitem__)]
        widths[s] = best[1][s]
        left_out = left_out + near * best[2]
    return widths.unsqueeze(1), left_out
