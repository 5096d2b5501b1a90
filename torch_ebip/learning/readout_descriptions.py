"""How a read-out is put together, in plain values, as `descriptions` has filters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from torch_ebip.interaction.analogue_readout import VOICES, AnalogueReadout
from torch_ebip.interaction.analogues import Analogues
from torch_ebip.interaction.expert import Expert
from torch_ebip.interaction.horizons import HorizonShrinkage
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.readout import Readout
from torch_ebip.interaction.shrinkage import Shrinkage


def describe_readout(readout: Readout | None) -> Any:
    """In plain values, but for its numbers.

    Raises:
        TypeError: one that is not the library's.
    """
    if readout is None:
        return None
    if isinstance(readout, HorizonShrinkage | AnalogueReadout):
        seconds = [s if math.isfinite(s) else "end" for s in readout.seconds.tolist()]
        if isinstance(readout, AnalogueReadout):
            compared = readout.analogues.dofs.tolist()
            analogues = {"compared": compared, "unlike": readout.analogues.unlike}
            expert = {"expert": _describe_expert(readout.expert)}
            return {"seconds": seconds, "levels": readout.levels.tolist(), **analogues, **expert}
        return {"seconds": seconds, "levels": readout.levels.tolist()}
    if isinstance(readout, Shrinkage):
        return readout.leads.tolist()
    raise TypeError(f"a model file keeps the read-outs of the library, not {type(readout).__name__}")


def readout_of(description: Any, primitive: InteractionPrimitive) -> Readout:
    """The read-out that `describe_readout` described, of a primitive; its numbers are still to be filled in."""
    ones = primitive.weights.new_ones
    D = primitive.layout.n_dofs
    if isinstance(description, list):  # of older files
        return Shrinkage(ones(D, len(description)), description)
    seconds = [math.inf if s == "end" else float(s) for s in description["seconds"]]
    if "compared" in description:
        compared = torch.zeros(D, dtype=torch.bool, device="cpu")
        compared[description["compared"]] = True
        analogues = Analogues.of(primitive, compared, description.get("unlike", 0.0))  # before version 6: never
        K, levels = len(seconds), description.get("levels", [1.0])  # before version 5: one
        follow, correct = ones(K, D, len(levels) * D), ones(K, D, D)
        expert = _expert_of(description.get("expert"), primitive, seconds)  # before version 6: none
        heed = None if expert is None else ones(K, D, len(levels))
        return AnalogueReadout(analogues, follow, correct, ones(K, D, len(VOICES)), seconds, levels, expert, heed)
    levels = description["levels"]
    return HorizonShrinkage(ones(D, len(seconds), len(levels)), ones(D, len(seconds)), seconds, levels)


def _describe_expert(expert: Expert | None) -> dict[str, Any] | None:
    if expert is None:
        return None
    return {
        "seen": expert.seen.tolist(),
        "said": expert.said.tolist(),
        "windows": list(expert.windows),
        "hidden": expert.hidden,
        "networks": expert.networks,
    }


def _expert_of(
    description: dict[str, Any] | None, primitive: InteractionPrimitive, seconds: Sequence[float]
) -> Expert | None:
    if description is None:
        return None
    options = dict(description)
    seen, said = (
        torch.zeros(primitive.layout.n_dofs, dtype=torch.bool, device="cpu").index_fill(
            0, torch.tensor(options.pop(name), device="cpu"), True
        )
        for name in ("seen", "said")
    )
    return Expert.of(primitive, seen, said, seconds, **options)
