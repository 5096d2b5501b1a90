"""Which read-out a filter gets: drawn towards the mean alone, or stacked with analogues, perhaps with an expert.

Validation decides each.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.brief import brief
from torch_ebip.interaction.analogues import Analogues
from torch_ebip.interaction.expert import SLOWER, Expert
from torch_ebip.interaction.filter_kinds import InteractionEnsembleFilter
from torch_ebip.interaction.present import recent_of
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.learning.analogues import FEWEST, fit_analogues, moments_of
from torch_ebip.learning.drawing import Drawn, learn_drawing
from torch_ebip.learning.expert import FEWEST as ENOUGH
from torch_ebip.learning.expert import fit_experts
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.said import what_it_says
from torch_ebip.learning.stacked import learn_correction, learn_heed, put_together
from torch_ebip.learning.stages import Scores

PAYS = 0.01
"""Share of the CRPS that an expert must take off: it costs time, and what is chosen for a gain gains less later."""

Makes: TypeAlias = "Callable[[InteractionPrimitive, Tensor], Analogues]"
"""Analogues of a primitive that compare some DoFs, bool [D]."""


class ReadOut(NamedTuple):
    """What was decided.

    Attributes:
        drawn: the read-out that the filter now has, and what it comes to.
        scores: by stage: ``shrinkage``, ``analogues`` if they were tried, ``expert`` if one is heard.
        said: what the report says of them.
        remarks: what was not tried, and why.
    """

    drawn: Drawn
    scores: dict[str, Scores]
    said: dict[str, Any]
    remarks: list[str]

    def __repr__(self) -> str:
        return brief(self)


@without_autocast
def learn_readout(
    held_out: HeldOut,
    filter: InteractionEnsembleFilter,
    interactions: Tensor,
    scored: Tensor,
    analogues: Makes | None,
    choose: bool = True,
    corrected: bool = True,
    expert: bool = True,
) -> ReadOut:
    """Give a filter the read-out with the smaller CRPS on interactions left out.

    Args:
        held_out: the demonstrations, and what is asked of them: seconds ahead.
        filter: changed; it has no read-out yet.
        interactions: int64 [B], that decide.
        scored: int64 [S], those among them whose scores are told.
        analogues: what makes them, such as `Analogues.of`; None: they are not tried.
        choose: whether they must be better; otherwise they are used wherever they can be.
        corrected: whether they are corrected by the filter and the mean, see `AnalogueReadout`.
        expert: whether one may be heard beside analogues, where it pays.
    """
    remarks = []
    task = held_out.task
    if analogues is not None and len(task.primitive) < FEWEST:
        remarks.append(f"no analogues: {len(task.primitive)} demonstrations, {FEWEST} tell what near means")
        analogues = None
    expert = expert and analogues is not None
    if expert and len(task.primitive) < ENOUGH:
        remarks.append(f"no expert: {len(task.primitive)} demonstrations, a network needs {ENOUGH}")
        expert = False
    if expert and task.objective.ahead is not None and len(task.objective.ahead) < 2:
        remarks.append("no expert: it needs horizons in seconds, and only the end is asked for")
        expert = False
    if analogues is not None:
        filter.analysis.recent = recent_of(task.primitive, slower=SLOWER if expert else ())
    with torch.no_grad():
        said = what_it_says(held_out, filter, interactions, None if analogues is None else moments_of(held_out))
    drawn = learn_drawing(held_out, said, scored)
    scores, told = {"shrinkage": drawn.scores}, {"shrinkage": drawn.shares}
    if analogues is not None:
        shown = torch.stack(list(task.subsets.values())).any(0)
        head = analogues(task.primitive, shown)
        without = fit_analogues(head, held_out, said)
        corrections = learn_correction(held_out, without, said, corrected)
        stacked = put_together(held_out, head, corrections, said, scored)
        scores["analogues"] = stacked.scores
        if expert:
            assert task.objective.ahead is not None
            network = Expert.of(task.primitive, shown, task.targets, task.objective.ahead.tolist())
            experts = fit_experts(network, held_out, recent_of(task.primitive, slower=SLOWER), interactions)
            heeded = learn_heed(held_out, experts, said, corrections.drawn)
            pays = bool((heeded.heed > 0).any())
            with_it = put_together(held_out, head, corrections, said, scored, network, heeded) if pays else stacked
            heard = with_it.scores["crps"] < (1 - PAYS) * stacked.scores["crps"]
            told["expert"] = _told(heard, with_it, stacked, heeded.shares)
            if heard:
                scores["expert"], stacked = with_it.scores, with_it
            else:
                filter.analysis.recent = recent_of(task.primitive)
        used = not choose or stacked.scores["crps"] < drawn.scores["crps"]
        told["analogues"] = _told(used, stacked, drawn, corrections.shares)
        if used:
            drawn = stacked
        else:
            filter.analysis.recent = None
            told.pop("expert", None)
    filter.readout = drawn.readout
    return ReadOut(drawn, scores, told, remarks)


def _told(used: bool, tried: Drawn, otherwise: Drawn, shares: dict[str, Any]) -> dict[str, Any]:
    """For the report."""
    crps, without = (round(each.scores["crps"], 5) for each in (tried, otherwise))
    return {"used": used, "shares": shares, "crps": crps, "crps_without": without}
