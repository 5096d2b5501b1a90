"""What `learn` gives a filter so that it is not sure and wrong, and how a model file says it: see `descriptions`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.interaction.bounds import Bounds
from torch_ebip.interaction.doubt import Doubt
from torch_ebip.interaction.filter_kinds import InteractionEnsembleFilter
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.surprise import InteractionSurprise
from torch_ebip.interaction.tail import BODY, FEWEST, Tail
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.partition import generator_of
from torch_ebip.learning.strangers import learn_doubt
from torch_ebip.learning.surprising import learn_surprise
from torch_ebip.recordings.demonstrations import Demonstrations

MOST = 100
"""Interactions that decide about doubt, at most, as strangers of each kind."""


def learn_caution(
    held_out: HeldOut,
    demonstrations: Demonstrations,
    filter: InteractionEnsembleFilter,
    chances: Mapping[str, float],
) -> tuple[dict[str, Any], list[str]]:
    """Give a filter its surprise, its doubt and its bounds, and say what they are, and what is missing.

    Args:
        held_out: of the demonstrations.
        demonstrations: N of them.
        filter: with its read-out.
        chances: ``suspect`` and ``rejected``, see `InteractionSurprise`.
    """
    filter.bounds = Bounds.of(held_out.task.primitive)
    order = generator_of(held_out.settings.seed, -4)
    interactions = torch.randperm(len(demonstrations), generator=order, device="cpu")
    surprise, said = learn_surprise(held_out, filter, interactions, **chances)
    if surprise is None:
        return {}, [too_few(len(demonstrations))]
    shown = {name for names in held_out.task.subsets.values() for name in _modalities(held_out, names)}
    remarks = [
        f"{name} is always believed: at least {FEWEST} demonstrations must have it, to say what of it is usual"
        for name in held_out.task.primitive.layout.names
        if name in shown and name not in said["sensors"]
    ]
    filter.analysis.surprise = surprise
    some = interactions[: max(FEWEST, MOST // len(held_out.task.subsets))]
    filter.doubt, doubt = learn_doubt(held_out, demonstrations, filter, some)
    return {**said, "doubt": doubt}, remarks


def _modalities(held_out: HeldOut, dofs: Tensor) -> list[str]:
    """Names of those of which some DoFs, bool [D], are shown."""
    layout = held_out.task.primitive.layout
    return [name for name in layout.names if bool(dofs[layout.slice(name)].any())]


def too_few(count: int) -> str:
    """The line of a report that says why nothing can be said of familiarity."""
    return (
        f"familiarity is NaN: {count} demonstrations, at least {FEWEST} with something of every set of sensors are "
        "needed to say what is familiar"
    )


@without_autocast
@torch.no_grad()
def familiar(held_out: HeldOut, filter: InteractionEnsembleFilter, interactions: Tensor) -> dict[str, Tensor]:
    """How interactions int64 [B], filtered by ensembles of others, look: what TensorBoard shows the distribution of.

    Returns:
        ``familiarity``, and of each sensor the largest multiple of what is usual: [B'] each, for all sets of sensors.
    """
    names = held_out.task.primitive.layout.names
    end = torch.ones(1, device="cpu")
    found: dict[str, list[Tensor]] = {}
    for subset in held_out.task.subsets.values():
        for trial in held_out.trials(filter, interactions, subset, end):
            trace, surprise = trial.trace, filter.surprise
            assert surprise is not None
            assert trace.familiarity is not None
            assert trace.surprise is not None
            found.setdefault("familiarity", []).append(trace.familiarity[:, -1])
            for number, name in enumerate(names):
                if bool(surprise.known[number]):
                    largest = trace.surprise[..., number].amax(-1).exp()
                    found.setdefault(f"multiple/{name}", []).append(largest)
    return {name: torch.cat(parts).cpu() for name, parts in found.items()}


def describe_caution(filter: InteractionFilter) -> dict[str, Any]:
    """``surprise``, ``doubt`` and ``bounds`` of a filter in plain values; None for what it has not."""
    surprise, doubt, bounds = filter.surprise, filter.doubt, filter.bounds
    return {
        "surprise": None if surprise is None else {**surprise.settings(), "calibrated": surprise.tail is not None},
        "doubt": None if doubt is None else doubt.levels.tolist(),
        "bounds": None if bounds is None else bounds.margin,
    }


def give_caution(filter: InteractionFilter, primitive: InteractionPrimitive, description: Mapping[str, Any]) -> None:
    """Give a filter of a primitive what `describe_caution` described; its numbers are still to be filled in."""
    like = primitive.weights
    surprise, doubt, bounds = (description.get(name) for name in ("surprise", "doubt", "bounds"))
    if surprise is not None:
        settings = dict(surprise)
        calibrated = settings.pop("calibrated")
        made = InteractionSurprise.of(primitive, **settings)
        if calibrated:
            made.tail = Tail(like.new_zeros(1, len(BODY)), like.new_ones(1))
        filter.analysis.surprise = made  # type: ignore[union-attr]
    if doubt is not None:
        levels = [float(level) for level in doubt]
        share = like.new_ones(len(levels))
        filter.doubt = Doubt(share, torch.zeros_like(share), like.new_zeros(primitive.layout.n_dofs), levels)
    filter.bounds = None if bounds is None else Bounds.of(primitive, float(bounds))
