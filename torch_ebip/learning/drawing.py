"""How far forecasts are drawn towards the training mean, and how wide they should be: from interactions left out.

By horizon and by target: the best share by least squares, held to what can be shown, see `shares`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.filtering.functional.scores import gaussian_crps
from torch_ebip.interaction.horizons import LEVELS, HorizonShrinkage
from torch_ebip.interaction.readout import Readout
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.objective import ForecastObjective
from torch_ebip.learning.said import Said
from torch_ebip.learning.shares import best_shares, standard_errors, trust, widening
from torch_ebip.learning.stages import Scores, scores_of, tally
from torch_ebip.recordings.layout import Layout


class Drawn(NamedTuple):
    """What was found.

    Attributes:
        readout: to be given to the filter.
        shares: of each target modality, the mean share by horizon; of several voices, by voice.
        scores: after it; each interaction drawn by what was learned without its fold.
        gain: by horizon, by how many standard errors the squared error is then less than the training mean's, pair by
            pair.
        gain_alone: the same of the filter alone.
    """

    readout: Readout
    shares: dict[str, Any]
    scores: Scores
    gain: dict[str, float]
    gain_alone: dict[str, float]


@without_autocast
@torch.no_grad()
def learn_drawing(held_out: HeldOut, said: Said, scored: Tensor) -> Drawn:
    """What a filter's forecasts should pass through.

    With few interactions the shares are pulled towards 1, where the filter speaks alone, before their gain is asked.

    Args:
        held_out: the demonstrations, and what is asked of them: seconds ahead.
        said: by the filter, without a read-out, of the interactions that decide.
        scored: int64 [S], those among them whose scores are told.
    """
    layout, _, targets, ahead, names = asked_of(held_out)
    fold = held_out.partition.fold_of.to(said.towards.device)[said.interaction]
    modality = layout.modality_of_dof.to(fold.device)
    S, J, D = said.place.shape[-1], len(LEVELS), layout.n_dofs
    share, wider = said.own.new_ones(D, S, J), said.own.new_ones(D, S)
    drawn, deviation = torch.zeros_like(said.towards), torch.zeros_like(said.towards)
    shares: dict[str, Any] = {}
    pull = 2 / len(set(said.interaction.tolist()))
    for m in sorted(set(modality[targets].tolist())):
        ours, here = modality[targets] == m, (modality == m) & targets
        part = _of(said, ours)
        voices = part.level * part.towards.unsqueeze(-1)
        best, without = best_shares(voices, part.place, part.wanted, fold, held_out.settings.folds, pull)
        mine = torch.einsum("rkps,rsj,rkpdj->rkpd", part.place, without[fold], part.level)
        believed = trust(part.interaction, part.wanted, mine * part.towards, part.place)
        mine = torch.einsum("rkps,rsj,rkpdj->rkpd", part.place * believed, without[fold], part.level)
        share[here] = best * believed.unsqueeze(-1)
        width = (1 - mine) * part.demonstrated + mine * part.own
        miss = (part.wanted - mine * part.towards).abs() / width.clamp(min=1e-12)
        whole, left_out = widening(miss, part.place, fold)
        wider[here] = whole
        drawn[..., ours] = mine * part.towards
        deviation[..., ours] = width * torch.einsum("rkps,rs->rkp", part.place, left_out).unsqueeze(-1)
        shares[layout.names[m]] = {name: round(float(mine[:, :, p].mean()), 4) for p, name in enumerate(names)}
    return drawn_of(held_out, said, scored, HorizonShrinkage(share, wider, ahead.tolist()), shares, drawn, deviation)


def asked_of(held_out: HeldOut) -> tuple[Layout, ForecastObjective, Tensor, Tensor, tuple[str, ...]]:
    """Layout, objective, targets bool [D], seconds [P] and their names."""
    task = held_out.task
    assert task.objective.horizons is not None
    assert task.objective.ahead is not None
    return task.primitive.layout, task.objective, task.targets, task.objective.ahead, task.objective.horizons


def drawn_of(
    held_out: HeldOut,
    said: Said,
    scored: Tensor,
    readout: Readout,
    shares: dict[str, Any],
    drawn: Tensor,
    deviation: Tensor,
) -> Drawn:
    """What a read-out comes to, of forecasts ``drawn`` less the mean and their ``deviation`` [R, K, P, D]."""
    _, objective, _, _, names = asked_of(held_out)
    told = torch.isin(said.interaction, scored.to(said.interaction.device))
    if said.counted is not None:
        drawn, deviation = drawn[:, said.counted], deviation[:, said.counted]
        named = ((name, getattr(said, name)) for name in ("wanted", "towards", "usual"))
        said = said._replace(**{name: part[:, said.counted] for name, part in named if part is not None})
    error = (drawn - said.wanted)[told]
    after = scores_of(tally(held_out, error * objective.scale, deviation[told] * objective.scale))
    each = gaussian_crps(error, deviation[told].square(), torch.zeros_like(error)).nanmean((0, 1, 3))
    after["crps"] = float(each.nanmean())
    usual = torch.zeros_like(said.wanted[told]) if said.usual is None else said.usual[told]
    wanted = said.wanted[told] - usual
    gains = [
        {
            name: standard_errors(said.interaction[told], wanted[:, :, p : p + 1], other[:, :, p : p + 1])
            for p, name in enumerate(names)
        }
        for other in (drawn[told] - usual, said.towards[told] - usual)
    ]
    return Drawn(readout, shares, after, *gains)


def _of(said: Said, ours: Tensor) -> Said:
    """Of some of the targets, bool [D]."""
    names = ("towards", "wanted", "own", "demonstrated", "level", "mean")
    return said._replace(**{name: getattr(said, name)[:, :, :, ours] for name in names})
