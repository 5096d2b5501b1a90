"""Whether a filter follows the phase by a bank of hypotheses, too, and how sharply that looks: by validation.

Nobody demonstrates how they are interrupted. So interactions left out are interrupted here, and a bank is taken if
it makes forecasts of those better and of what goes on undisturbed hardly worse.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from torch_ebip.common.ambient import without_autocast
from torch_ebip.interaction.filter_kinds import InteractionEnsembleFilter
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.pace.phase_bank import PhaseBank
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.learning.crps import crps_of
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.interruptions import again, idle, interrupted, late, pause
from torch_ebip.learning.partition import generator_of
from torch_ebip.recordings.demonstrations import Demonstrations

KINDS = [pause(0.2, 3.0), idle(0.5, 3.0), late(0.2, 0.6), again(0.2, 0.6)]
"""Of interruptions, in turn."""
TRIED = ((1.0, 1.0), (1.0, 2.0), (2.0, 3.0))
"""What distances count, as multiples of what they do at first, and by how many deviations phases may differ."""
COSTS = 0.01
"""Share by which forecasts of undisturbed interactions may get worse."""


@without_autocast
@torch.no_grad()
def learn_pace(
    held_out: HeldOut, demonstrations: Demonstrations, filter: InteractionEnsembleFilter
) -> dict[str, Any]:
    """Give a filter a `PhaseBank`, where that is better, and say what it gave.

    Args:
        held_out: of the demonstrations.
        demonstrations: N of them.
        filter: with everything else that it has.

    Returns:
        ``used``, ``sharpness`` and ``agree``, and the CRPS over all horizons and DoFs, in units of the targets'
        spread, ``with`` and ``without`` it, of interactions ``undisturbed`` and ``interrupted``, the latter ``with``
        a bank only where it may be used; or a ``reason``.
    """
    task = held_out.task
    primitive = task.primitive
    try:
        banks = {settings: _bank(primitive, *settings) for settings in TRIED}
    except ValueError as error:
        return {"used": False, "reason": str(error)}
    # As on the robot: a step of the bank is a tenth of a second, and tuning thins more than that.
    unthinned = replace(held_out.settings, thinning=1)
    noise = primitive.residual_variance.sqrt().cpu()
    draws = generator_of(held_out.settings.seed, -5)
    disturbed = [made.values for made in interrupted(demonstrations, KINDS, noise, draws)]
    both = {
        "undisturbed": HeldOut(demonstrations, task, unthinned, held_out.ranks),
        "interrupted": HeldOut(
            Demonstrations(demonstrations.layout, disturbed, demonstrations.rate), task, unthinned, held_out.ranks
        ),
    }
    order = torch.randperm(len(demonstrations), generator=draws, device="cpu")

    filter.analysis.pace = None  # of those that repeat, which were tuned with one
    without = {name: crps_of(each, filter, order) for name, each in both.items()}
    tried: dict[tuple[float, float], dict[str, float]] = {}
    fair = []
    try:
        for settings, bank in banks.items():
            filter.analysis.pace = bank
            tried[settings] = {"undisturbed": crps_of(both["undisturbed"], filter, order)}
            if tried[settings]["undisturbed"] <= (1 + COSTS) * without["undisturbed"]:
                fair.append(settings)
                tried[settings]["interrupted"] = crps_of(both["interrupted"], filter, order)
    except KeyboardInterrupt:
        filter.analysis.pace = None  # of those tried none has been chosen
        raise
    best = min(fair, key=lambda settings: tried[settings]["interrupted"]) if fair else TRIED[-1]
    used = bool(fair) and tried[best]["interrupted"] < without["interrupted"]
    filter.analysis.pace = banks[best] if used else None
    told: dict[str, Any] = {"used": used, "sharpness": best[0], "agree": best[1]}
    for name, values in (("with", tried[best]), ("without", without)):
        told[name] = {kind: round(value, 5) for kind, value in values.items()}
    return told


def _bank(primitive: InteractionPrimitive, sharpness: float, agree: float) -> PhaseBank:
    """A bank whose distances count so many times what they do at first."""
    bank = PhaseBank.of(primitive, agree=agree)
    bank.settings[3:5] *= sharpness  # of values and velocities
    return bank


def describe_pace(filter: InteractionFilter) -> dict[str, Any] | None:
    """The sizes of a filter's bank in plain values, None where it has none; its settings are among its numbers."""
    pace = filter.pace
    if pace is None:
        return None
    return {"phases": pace.likeness.n_phases, "most": len(pace.which), "period": pace.period}


def pace_of(primitive: InteractionPrimitive, description: Mapping[str, Any] | None) -> PhaseBank | None:
    """The bank of a primitive that `describe_pace` described; its settings are still to be filled in."""
    if description is None:
        return None
    phases, most = int(description["phases"]), int(description["most"])
    return PhaseBank.of(primitive, phases, most, period=float(description["period"]))
