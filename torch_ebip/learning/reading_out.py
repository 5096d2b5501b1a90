"""Which read-out a filter gets: drawn towards the mean alone, or stacked with analogues; validation decides."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.brief import brief
from torch_ebip.interaction.analogues import Analogues
from torch_ebip.interaction.filter_kinds import InteractionEnsembleFilter
from torch_ebip.interaction.present import recent_of
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.learning.analogues import FEWEST, fit_analogues, learn_stacking, moments_of
from torch_ebip.learning.drawing import Drawn, learn_drawing
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.said import what_it_says
from torch_ebip.learning.stages import Scores

Makes: TypeAlias = "Callable[[InteractionPrimitive, Tensor], Analogues]"
"""Analogues of a primitive that compare some DoFs, bool [D]."""


class ReadOut(NamedTuple):
    """What was decided.

    Attributes:
        drawn: the read-out that the filter now has, and what it comes to.
        scores: of each that was tried, by stage: ``shrinkage`` and ``analogues``.
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
    """
    remarks = []
    task = held_out.task
    if analogues is not None and len(task.primitive) < FEWEST:
        remarks.append(f"no analogues: {len(task.primitive)} demonstrations, {FEWEST} tell what near means")
        analogues = None
    if analogues is not None:
        filter.analysis.recent = recent_of(task.primitive)
    with torch.no_grad():
        said = what_it_says(held_out, filter, interactions, None if analogues is None else moments_of(held_out))
    drawn = learn_drawing(held_out, said, scored)
    scores, told = {"shrinkage": drawn.scores}, {"shrinkage": drawn.shares}
    if analogues is not None:
        shown = torch.stack(list(task.subsets.values())).any(0)
        head = analogues(task.primitive, shown)
        without = fit_analogues(head, held_out, said)
        stacked = learn_stacking(held_out, head, without, said, scored, corrected)
        scores["analogues"] = stacked.scores
        used = not choose or stacked.scores["crps"] < drawn.scores["crps"]
        told["analogues"] = {"used": used, "shares": stacked.shares, "crps": round(stacked.scores["crps"], 5),
                             "crps_without": round(drawn.scores["crps"], 5)}  # fmt: skip
        if used:
            drawn = stacked
        else:
            filter.analysis.recent = None
    filter.readout = drawn.readout
    return ReadOut(drawn, scores, told, remarks)
