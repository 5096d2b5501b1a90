"""How surprised a filter is by interactions that it should know: from which level on that says something.

Interactions are filtered by ensembles of others, whole and at their full rate, as a session would; nobody is judged
then. What was noticed is kept, and judged afterwards: first what is usual at a phase, then how large levels become in
a whole interaction, sensor by sensor, then the same of all together.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.brief import brief
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.updates.surprise import Noticed
from torch_ebip.interaction.filter_kinds import InteractionEnsembleFilter
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.surprise import POINTS, InteractionSurprise
from torch_ebip.interaction.surprise_memory import SurpriseMemory
from torch_ebip.interaction.tail import FEWEST
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.ranks import Ranks

MOST = 200
"""Interactions that decide, at most."""
SMOOTH = 0.05
"""Phase over which what is usual is smoothed, a standard deviation."""
FINEST = 4
"""Times as many interactions as there are would show the smallest chance that is looked for."""
LEAST_USUAL = 0.05
"""Of a square, as a share of its mean over all phases."""


class Heard(NamedTuple):
    """A sample of some interactions as it was noticed, or a time that passed.

    Attributes:
        by: the surprise of the DoFs that are shown.
        noticed: the sample, [B, K]; None: time passed.
        dt: [], s; None: a sample.
    """

    by: InteractionSurprise
    noticed: Noticed | None
    dt: Tensor | None

    def __repr__(self) -> str:
        return brief(self)


class Conversation(NamedTuple):
    """What was heard of some interactions.

    Attributes:
        heard: one after the other.
        size: how many interactions.
        alone: whether only one of several sensors was shown, beside the sets that were asked for.
    """

    heard: list[Heard]
    size: int
    alone: bool

    def __repr__(self) -> str:
        return brief(self)


class _Listener(InteractionSurprise):
    """Keeps what it is asked to judge, and judges nobody."""

    heard: list[Heard]

    def forget(self, memory: SurpriseMemory, dt: Tensor) -> SurpriseMemory:
        """Time passes."""
        self.heard.append(Heard(self, None, dt))
        return memory

    def judge(self, memory: SurpriseMemory, noticed: Noticed) -> tuple[SurpriseMemory, Tensor | None]:
        """A copy: carriers use their buffers again."""
        kept = Noticed(*(part if part is None else part.clone() for part in noticed))  # type: ignore[arg-type]
        self.heard.append(Heard(self, kept, None))
        return memory, None


@without_autocast
@torch.no_grad()
def learn_surprise(
    held_out: HeldOut, filter: InteractionEnsembleFilter, interactions: Tensor, **settings: float
) -> tuple[InteractionSurprise | None, dict[str, Any]]:
    """What the filter's `InteractionSurprise` should be, and what the report says of it.

    Args:
        held_out: the demonstrations.
        filter: that will be asked; without a surprise.
        interactions: int64 [B], that decide.
        settings: of `InteractionSurprise`.

    Returns:
        None where there are fewer than `FEWEST` interactions.
    """
    primitive = held_out.task.primitive
    surprise = InteractionSurprise.of(primitive, **settings)
    if len(interactions) < FEWEST:
        return None, {}
    # Several sets of sensors say several times something of the same interaction.
    some = interactions[: max(FEWEST, MOST // len(held_out.task.subsets))]
    conversations = listen(held_out, filter, some, primitive)
    surprise.usual.copy_(_usual(surprise, conversations, held_out.ranks))
    surprise.usual_bias.copy_(_usual_bias(surprise, conversations, held_out.ranks))
    largest, _, alone = _largest(surprise, conversations, held_out.ranks)
    finest = 1 / (FINEST * len(some))
    surprise.know(largest[~alone], finest)
    shown = (~largest.isnan().any(-1) & surprise.known).sum(-1)
    _, parts, _ = _largest(surprise, conversations, held_out.ranks)
    most = shown[~alone].sort(descending=True).values[FEWEST - 1]  # sensors that enough interactions have
    if int(most) < 1:
        return None, {}
    together = (shown >= most) & ~alone
    surprise.know_pace(parts[together, :2])
    if int(most) > 1 and int((shown == 1).sum()) >= FEWEST:
        # The larger of both has its largest where one of them has it.
        whole = surprise.whole(parts[..., :3])
        surprise.know_alone(whole[together], whole[shown == 1])
    whole = _largest(surprise, conversations, held_out.ranks)[1][:, 3]
    surprise.know_whole(whole[~alone & (shown > 0)])
    assert surprise.tail is not None
    rejected = max(surprise.rejected, finest)
    names = [name for name, known in zip(primitive.layout.names, surprise.known.tolist(), strict=True) if known]
    return surprise, {
        "interactions": len(some),
        "sensors": names,
        "chances": {"suspect": max(surprise.suspect, 2 * rejected), "rejected": rejected},
        "largest": [round(value, 4) for value in surprise.tail.quantiles[0].tolist()],
    }


def listen(
    held_out: HeldOut, filter: InteractionEnsembleFilter, interactions: Tensor, primitive: InteractionPrimitive
) -> list[Conversation]:
    """What is noticed of interactions int64 [B], by portions, with how many each has."""
    whole = copy.copy(held_out)
    whole.settings = replace(held_out.settings, thinning=1)
    listener = _Listener.of(primitive)
    assert isinstance(listener, _Listener)
    hearing = sharing(filter)
    hearing.analysis = sharing(filter.analysis)
    hearing.analysis.surprise = listener
    found = []
    end = torch.ones(1, device="cpu")
    sets = [(subset, interactions, False) for subset in held_out.task.subsets.values()]
    sets += [(subset, interactions[:some], True) for subset, some in _alone(held_out)]
    for subset, some, alone in sets:
        for shown in whole.portions(some, subset, end):
            heard: list[Heard] = []
            listener.heard = heard
            whole.filter(hearing, shown, -1)
            found.append(Conversation(heard, len(shown.interactions), alone))
    return found


def _alone(held_out: HeldOut) -> list[tuple[Tensor, int]]:
    """Each sensor by itself, bool [D], where there are several and that is no set already, and for how many."""
    layout, subsets = held_out.task.primitive.layout, held_out.task.subsets.values()
    shown = torch.stack(list(subsets)).any(0)
    each = [shown & layout.mask([name]).to(shown.device) for name in layout.names]
    each = [one for one in each if bool(one.any())]
    if len(each) < 2:
        return []
    count = max(FEWEST, MOST // (2 * len(each)))
    return [(one, count) for one in each if not any(torch.equal(one, subset) for subset in subsets)]


def _usual(surprise: InteractionSurprise, conversations: list[Conversation], ranks: Ranks) -> Tensor:
    """[P, 2, S], means of both squares at the phases of the grid, smoothed."""
    sums = surprise.usual.new_zeros(2, *surprise.usual.shape).double()
    for conversation in conversations:
        for by, noticed, _ in conversation.heard if not conversation.alone else ():
            if noticed is not None:
                squares, here, _ = by.squares(noticed)
                _add(sums, noticed, squares, here.unsqueeze(-2))
    return _smoothed(sums, ranks).to(surprise.usual)


def _usual_bias(surprise: InteractionSurprise, conversations: list[Conversation], ranks: Ranks) -> Tensor:
    """[P, S], the mean square of the bias at the phases of the grid, smoothed."""
    sums = surprise.usual.new_zeros(2, *surprise.usual_bias.shape).double()
    for heard, count, alone in conversations:
        for noticed, _, here, both in _told(surprise, heard, count) if not alone else ():
            _add(sums, noticed, both[..., 1].exp(), here)
    return _smoothed(sums, ranks).to(surprise.usual)


def _add(sums: Tensor, noticed: Noticed, values: Tensor, here: Tensor) -> None:
    """To sums and counts [2, P, ...] of what was noticed, values [B, ...] where they are here, 1 or 0."""
    place = (noticed.mean[..., 0].clamp(0, 1) * (POINTS - 1)).round().long()
    weight = here.expand_as(values).double()
    sums[0].index_add_(0, place, values.double() * weight)
    sums[1].index_add_(0, place, weight)


def _smoothed(sums: Tensor, ranks: Ranks) -> Tensor:
    """[P, ...], means over phases near by, of sums and counts [2, P, ...] over all processes."""
    ranks.add_up([sums])
    grid = torch.linspace(0, 1, POINTS, dtype=sums.dtype, device=sums.device)
    near = torch.exp(-0.5 * ((grid - grid[:, None]) / SMOOTH).square())
    total, counts = torch.einsum("pq,nq...->np...", near, sums)
    overall = sums[0].sum(0) / sums[1].sum(0).clamp(min=1)
    overall = torch.where(overall > 0, overall, 1)
    return torch.maximum(total / counts.clamp(min=1e-9), LEAST_USUAL * overall)


def _largest(
    surprise: InteractionSurprise, conversations: list[Conversation], ranks: Ranks
) -> tuple[Tensor, Tensor, Tensor]:
    """The largest logarithms of each sensor [B, S, 2], NaN where it was not shown; of each part of the whole and of
    the whole [B, 4]; and whether one sensor was alone, bool [B]."""
    found = [_largest_of(surprise, conversation) for conversation in conversations]
    everyone = [parts for rank in ranks.gather([[part.cpu() for part in parts] for parts in found]) for parts in rank]
    logarithms, whole, alone = (torch.cat(parts).to(surprise.noise.device) for parts in zip(*everyone, strict=True))
    return logarithms, whole, alone


def _largest_of(surprise: InteractionSurprise, conversation: Conversation) -> tuple[Tensor, Tensor, Tensor]:
    """The same of one conversation."""
    heard, count, alone = conversation
    lowest = surprise.noise.new_full((count,), -torch.inf)
    largest, whole = lowest[:, None, None].expand(-1, surprise.n_sensors, 2), lowest[:, None].expand(-1, 4)
    for noticed, memory, here, both in _told(surprise, heard, count):
        seen = here > 0
        largest = torch.where(seen.unsqueeze(-1), torch.maximum(largest, both), largest)
        parts, _ = surprise.verdict(memory, noticed)
        parts = torch.cat([parts, surprise.whole(parts).unsqueeze(-1)], -1)
        whole = torch.where(seen.any(-1, keepdim=True), torch.maximum(whole, parts), whole)
    return torch.where(largest.isinf(), torch.nan, largest), whole, torch.full_like(lowest, alone, dtype=torch.bool)


def _told(
    surprise: InteractionSurprise, heard: list[Heard], count: int
) -> Iterator[tuple[Noticed, SurpriseMemory, Tensor, Tensor]]:
    """A conversation about so many interactions once more: each sample, the memory after it, which sensors it has,
    1 or 0 [B, S], and the logarithms of levels, [B, S, 2], see `SensorLevels.update`."""
    memory = surprise.start(surprise.noise.new_zeros(count, 1, 1))
    parts: dict[int, InteractionSurprise] = {}
    for by, noticed, dt in heard:
        if noticed is None:
            assert dt is not None
            memory = surprise.forget(memory, dt)
            continue
        if id(by) not in parts:  # what listened has the DoFs that were shown, but nothing learned
            parts[id(by)] = part = sharing(surprise)
            for name in ("mean", "variance", "noise", "sensor_of_dof", "place_of_dof"):
                part.register_buffer(name, getattr(by, name))
            part.stride = by.stride
        memory, seen, both = parts[id(by)].update(memory, noticed)
        yield noticed, memory, seen.to(both), both
