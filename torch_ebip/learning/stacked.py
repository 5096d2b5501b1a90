"""How much analogues, the filter, the mean and an expert count beside each other, and how wide all together are.

Each voice speaks of interactions by what it learned without their fold; so does each choice between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.brief import brief
from torch_ebip.interaction.analogue_readout import VOICES, AnalogueReadout
from torch_ebip.interaction.analogues import Analogues
from torch_ebip.interaction.expert import Expert
from torch_ebip.interaction.horizons import LEVELS
from torch_ebip.interaction.readout import Widths, surer
from torch_ebip.learning.analogues import fold_of, what_analogues_say
from torch_ebip.learning.drawing import Drawn, asked_of, drawn_of
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.said import Said
from torch_ebip.learning.shares import best_shares, stretching, trust
from torch_ebip.learning.stacking import best_correction, best_width

SUREST = 0.01
"""Share of what was said that was surer than what counts as the surest."""


class Corrected(NamedTuple):
    """Analogues that are corrected by the filter and the mean.

    Attributes:
        follow, correct: see `AnalogueReadout`.
        spread: [R, K, P, D], deviation of the analogues, units of the scale.
        drawn: [R, K, P, D], what it comes to less the mean.
        shares: for the report, by modality.
    """

    follow: Tensor
    correct: Tensor
    spread: Tensor
    drawn: Tensor
    shares: dict[str, Any]

    def __repr__(self) -> str:
        return brief(self)


class Heeded(NamedTuple):
    """The same with an expert.

    Attributes:
        heed: see `AnalogueReadout`.
        drawn: [R, K, P, D], what it comes to less the mean.
        shares: for the report, by modality.
    """

    heed: Tensor
    drawn: Tensor
    shares: dict[str, Any]

    def __repr__(self) -> str:
        return brief(self)


@without_autocast
@torch.no_grad()
def learn_correction(
    held_out: HeldOut, without: Sequence[Analogues], said: Said, corrected: bool = True
) -> Corrected:
    """How analogues are corrected by the filter and the mean.

    Args:
        held_out: the demonstrations, and what is asked of them: seconds ahead.
        without: analogues tuned without each fold, see `fit_analogues`.
        said: by the filter, without a read-out, of the interactions that decide.
        corrected: otherwise analogues speak alone.
    """
    layout, objective, targets, _, names = asked_of(held_out)
    scale = objective.scale
    theirs, spread = what_analogues_say(held_out, without, said)
    fold, modality = fold_of(held_out, said), layout.modality_of_dof.to(theirs.device)
    S, D, J = said.place.shape[-1], layout.n_dofs, said.level.shape[-1]
    follow = torch.eye(D, dtype=theirs.dtype, device=theirs.device).repeat(S, J, 1, 1)  # [S, J, D, D]
    correct, drawn = theirs.new_zeros(S, D, D), torch.zeros_like(theirs)
    shares: dict[str, Any] = {}
    for m in sorted(set(modality[targets].tolist())):
        ours, here = modality[targets] == m, ((modality == m) & targets).nonzero().squeeze(-1)
        wanted, n = said.wanted[..., ours], len(here)
        apart = (said.towards - theirs)[..., ours].unsqueeze(-2) * said.level[..., ours, :].transpose(-1, -2)
        voices = int(corrected) * torch.cat([apart.flatten(-2), theirs[..., ours]], -1)
        found = best_correction(voices, said.place, wanted - theirs[..., ours], fold, held_out.settings.folds)
        # B and C are in units of the scale, which each horizon has of its own.
        units = scale[:, ours]
        per = units.unsqueeze(-1) / units.unsqueeze(-2)
        whole = found.whole.reshape(S, n, J + 1, n)  # [S, n, J + 1, n]
        for j in range(J):
            follow[:, j, here.unsqueeze(-1), here] = whole[..., j, :] * per
        correct[:, here.unsqueeze(-1), here] = whole[..., J, :] * per
        drawn[..., ours] = theirs[..., ours] + found.left_out
        diagonals = whole.diagonal(0, 1, 3).mean(-1).tolist()  # [S, J + 1]
        shares[layout.names[m]] = {
            part: {name: round(values[i], 3) for name, values in zip(names, diagonals, strict=True)}
            for i, part in ((0, "follow_sure"), (J - 1, "follow_unsure"), (J, "correct"))
        }
    return Corrected(follow.transpose(1, 2).flatten(-2), correct, spread, drawn, shares)


@without_autocast
@torch.no_grad()
def learn_heed(held_out: HeldOut, experts: Sequence[Expert], said: Said, drawn: Tensor) -> Heeded:
    """How much an expert counts beside forecasts without it: by horizon, and by how sure the filter is.

    Shares are pulled to 0, and count only as far as interactions left out can show that they pay, see `trust`.

    Args:
        held_out: the demonstrations, and what is asked of them: seconds ahead.
        experts: trained without each fold, see `fit_experts`.
        said: by the filter, that remembers the expert's windows.
        drawn: [R, K, P, D], the forecasts less the mean, units of the scale.
    """
    layout, objective, targets, _, names = asked_of(held_out)
    assert said.present is not None
    assert said.present.before is not None
    fold, modality = fold_of(held_out, said), layout.modality_of_dof.to(drawn.device)
    inputs = experts[0].inputs(said.present.before)
    voice = torch.empty_like(drawn)
    for f, expert in enumerate(experts):
        voice[fold == f] = expert.read(inputs[fold == f]) / objective.scale
    # Where the filter takes a horizon to lie behind the end it is asked of a nearer one.
    voice = said.place @ voice
    apart = (voice - said.mean - drawn) * experts[0].believed(said.present.before)[..., None, None]
    S, J = said.place.shape[-1], said.level.shape[-1]
    heed, together = drawn.new_zeros(S, layout.n_dofs, J), drawn.clone()
    shares: dict[str, Any] = {}
    pull = 2 / len(set(said.interaction.tolist()))
    for m in sorted(set(modality[targets].tolist())):
        ours, here = modality[targets] == m, ((modality == m) & targets).nonzero().squeeze(-1)
        voices = said.level[..., ours, :] * apart[..., ours].unsqueeze(-1)
        wanted = (said.wanted - drawn)[..., ours]
        # What is left of the forecasts without it is pulled to all of them.
        best, without = best_shares(-voices, said.place, wanted - voices.sum(-1), fold, held_out.settings.folds, pull)

        def gain(believed: Tensor, without: Tensor = without, voices: Tensor = voices) -> Tensor:
            """[R, K, P, n], what the expert changes, each by what was learned without its fold."""
            return torch.einsum("rkps,rsj,rkpdj->rkpd", said.place * believed, 1 - without[fold], voices)

        believed = trust(said.interaction, wanted, gain(drawn.new_ones(S)), said.place)
        heed[:, here] = ((1 - best) * believed.unsqueeze(-1)).unsqueeze(1)
        together[..., ours] = drawn[..., ours] + gain(believed)
        diagonals = heed[:, here[0]].tolist()
        shares[layout.names[m]] = {
            part: {name: round(values[j], 3) for name, values in zip(names, diagonals, strict=True)}
            for j, part in ((0, "heed_sure"), (J - 1, "heed_unsure"))
        }
    return Heeded(heed, together, shares)


@without_autocast
@torch.no_grad()
def put_together(
    held_out: HeldOut,
    analogues: Analogues,
    corrected: Corrected,
    said: Said,
    scored: Tensor,
    expert: Expert | None = None,
    heeded: Heeded | None = None,
) -> Drawn:
    """The read-out, as wide as its errors were, and what it comes to.

    Args:
        held_out: the demonstrations, and what is asked of them: seconds ahead.
        analogues: as they will be used.
        corrected: how they are corrected.
        said: by the filter, without a read-out, of the interactions that decide.
        scored: int64 [S], those among them whose scores are told.
        expert, heeded: as it will be used, and how much it counts; default: there is none.
    """
    layout, _, targets, ahead, _ = asked_of(held_out)
    drawn, widths = corrected.drawn if heeded is None else heeded.drawn, Widths(said.own, said.demonstrated)
    surest = drawn.new_zeros(said.place.shape[-1], layout.n_dofs)
    stretch = drawn.new_ones(*surest.shape, said.level.shape[-1])
    fold, modality = fold_of(held_out, said), layout.modality_of_dof.to(drawn.device)
    width, deviation = drawn.new_zeros(said.place.shape[-1], layout.n_dofs, len(VOICES)), torch.zeros_like(drawn)
    width[..., 0] = 1
    of_each = torch.stack([said.own, corrected.spread, said.demonstrated], -1)
    for m in sorted(set(modality[targets].tolist())):
        ours, here = modality[targets] == m, ((modality == m) & targets).nonzero().squeeze(-1)
        least = _surest(said, ours)
        surest[:, here] = least.unsqueeze(-1)
        sure = surer(Widths(*(part[..., ours] for part in widths)), (said.place @ least).unsqueeze(-1))
        drawn = drawn.clone()
        drawn[..., ours] = torch.lerp(drawn[..., ours], said.towards[..., ours], sure)
        error, level = (said.wanted - drawn)[..., ours], said.level[..., ours, :]
        width[:, here], wide = best_width(of_each[..., ours, :], said.place, error, fold, held_out.settings.folds)
        whole, each = stretching(error.abs() / wide.clamp(min=1e-12), said.place, level, fold)
        stretch[:, here] = whole.unsqueeze(1)
        deviation[..., ours] = wide * torch.einsum("rkps,rsj,rkpdj->rkpd", said.place, each, level)
    heed = None if heeded is None else heeded.heed
    parts = (corrected.follow, corrected.correct, width, ahead.tolist(), LEVELS, expert, heed, surest, stretch)
    readout = AnalogueReadout(analogues, *parts)
    return drawn_of(held_out, said, scored, readout, corrected.shares, drawn, deviation)


def _surest(said: Said, ours: Tensor) -> Tensor:
    """[S], as a share of how far demonstrations lie apart, of some targets, bool [D]; 0: nothing was measured."""
    measured = ~said.wanted[..., ours].isnan() & (said.demonstrated[..., ours] > 0)
    ratio = torch.where(measured, said.own[..., ours] / said.demonstrated[..., ours], torch.nan)
    found = ratio.new_zeros(said.place.shape[-1])
    for s in range(len(found)):
        values = ratio[said.place[..., s] > 0.5]
        values = values[~values.isnan()]
        if len(values):
            found[s] = values.quantile(SUREST)
    return found
