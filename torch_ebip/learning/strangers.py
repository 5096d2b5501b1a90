"""Interactions that nobody showed, made of those that somebody did; and how far a filter may be believed in them.

A demonstration is strange to an ensemble of those that are least like it; and played at another speed, or led
astray, to any. Of all the truth is known, so that it can be learned how much of a forecast should be left, and how
wide it should be, by how much the filter was surprised.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.brief import brief
from torch_ebip.filtering.functional.scores import gaussian_crps
from torch_ebip.interaction.doubt import ELSEWHERE, LEVELS, Doubt
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.readout import hats
from torch_ebip.interaction.table import DemonstrationTable
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.interruptions import played_at
from torch_ebip.learning.metrics import Z95
from torch_ebip.learning.partition import Partition, generator_of
from torch_ebip.learning.said import Said, what_it_says
from torch_ebip.recordings.demonstrations import Demonstrations

SPEEDS = (0.4, 2.0)
"""At which demonstrations are played, as multiples of their own."""
INFLATIONS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""That are tried."""
FEWEST = 30
"""Moments of each kind that decide about a level of doubt, at least."""


class Unlike(Partition):
    """Ensembles of the half of the other folds that is least like each interaction.

    Args:
        partition: whose folds.
        apart: [N, N], how unlike demonstrations are.
    """

    def __init__(self, partition: Partition, apart: Tensor) -> None:
        self.__dict__ |= partition.__dict__
        others = self._others[self.fold_of]  # [N, O]
        order = apart.cpu().gather(1, others).argsort(-1, descending=True)
        self._unlike = others.gather(1, order[:, : max(2, others.shape[1] // 2)])

    def members(self, interactions: Tensor, generator: torch.Generator) -> Tensor:
        """Indices [B, E] of demonstrations, see `Partition.members`."""
        return self._unlike[interactions]


def unlikeness(primitive: InteractionPrimitive) -> Tensor:
    """[N, N], distances of demonstrations over all phases and DoFs, each in its own deviation."""
    table = DemonstrationTable.of(primitive, 11)
    scale = primitive.value_variance.clamp(min=1e-12).sqrt()
    paths = (table.cells[:, :, 0] / scale).flatten(1)
    return torch.cdist(paths, paths)


def played(demonstrations: Demonstrations, speed: float) -> Demonstrations:
    """The same movements at another speed, on the same clock; between samples linear, NaN beside NaN."""
    trajectories = [played_at(trajectory, speed)[0] for trajectory in demonstrations]
    return Demonstrations(demonstrations.layout, trajectories, demonstrations.rate)


def astray(demonstrations: Demonstrations, sensors: Tensor, generator: torch.Generator) -> Demonstrations:
    """Ways that leave their own for a while, towards that of another demonstration or away from it, and come back.

    Args:
        demonstrations: N of them.
        sensors: bool [D], what strays; what is forecast stays as it was.
        generator: of whom, when, and how far.
    """
    N = len(demonstrations)
    other = (torch.arange(N) + torch.randint(1, N, (N,), generator=generator)) % N
    start, far = torch.rand(N, generator=generator) * 0.4, (1 + torch.rand(N, generator=generator)) * 1.0
    sign = 2.0 * torch.randint(2, (N,), generator=generator) - 1
    trajectories = []
    for n, trajectory in enumerate(demonstrations):
        phase = torch.linspace(0, 1, len(trajectory))
        theirs = demonstrations[int(other[n])]
        there = theirs[(phase * (len(theirs) - 1)).round().long()]
        bump = torch.sin(math.pi * ((phase - start[n]) / 0.5).clamp(0, 1)).square().to(trajectory)
        moved = trajectory + (float(sign[n] * far[n]) * bump).unsqueeze(-1) * (there - trajectory)
        moved = torch.where(moved.isnan(), trajectory, moved)
        trajectories.append(torch.where(sensors, moved, trajectory))
    return Demonstrations(demonstrations.layout, trajectories, demonstrations.rate)


def strangers(held_out: HeldOut, demonstrations: Demonstrations) -> Iterator[HeldOut]:
    """Demonstrations, N of them, as strangers to those who are asked to filter them."""
    unlike = copy.copy(held_out)
    unlike.partition = Unlike(held_out.partition, unlikeness(held_out.task.primitive))
    yield unlike
    for speed in SPEEDS:
        yield HeldOut(played(demonstrations, speed), held_out.task, held_out.settings, held_out.ranks)
    generator = generator_of(held_out.settings.seed, -3)
    strayed = astray(demonstrations, ~held_out.task.targets.cpu(), generator)
    yield HeldOut(strayed, held_out.task, held_out.settings, held_out.ranks)


@without_autocast
@torch.no_grad()
def learn_doubt(
    held_out: HeldOut, demonstrations: Demonstrations, filter: InteractionFilter, interactions: Tensor
) -> tuple[Doubt, dict[str, Any]]:
    """What forecasts should pass through where an interaction surprises, and what the report says of it.

    Args:
        held_out: of the demonstrations.
        demonstrations: N of them.
        filter: with a surprise that is calibrated, and with its read-out.
        interactions: int64 [B], that decide.
    """
    kinds = [what_it_says(strange, filter, interactions) for strange in strangers(held_out, demonstrations)]
    primitive, targets = held_out.task.primitive, held_out.task.targets
    anywhere = _anywhere(primitive)
    scale = held_out.task.objective.scale
    elsewhere = ELSEWHERE * anywhere[targets] / scale.square()
    levels = scale.new_tensor(LEVELS)
    share, inflation, widening = torch.ones_like(levels), torch.zeros_like(levels), torch.zeros_like(levels)
    counts = []
    for k in range(1, len(levels)):
        near = [hats(said.doubt.clamp(levels[0], levels[-1]), levels)[..., k] >= 0.5 for said in kinds]
        counts.append([int(some.sum()) for some in near])
        here = [_part(said, some, elsewhere) for said, some in zip(kinds, near, strict=True)]
        share[k] = min(_share(here), float(share[k - 1]))
        inflation[k], widening[k] = _widths(here, share[k], inflation[k - 1], widening[k - 1])
    widening[-1] = max(float(widening[-1]), 1.0)
    said = {"share": share, "inflation": inflation, "widening": widening}
    return Doubt(share, widening, anywhere, inflation=inflation), {
        "levels": list(LEVELS),
        **{name: [round(value, 3) for value in values.tolist()] for name, values in said.items()},
        "moments": counts,
    }


class _Part(NamedTuple):
    """Forecasts at a level of doubt, [R, P, D], in units of the scale: see `Said`; and u^2, see `Doubt`."""

    towards: Tensor
    wanted: Tensor
    own: Tensor
    unit: Tensor

    def __repr__(self) -> str:
        return brief(self)


def _part(said: Said, near: Tensor, elsewhere: Tensor) -> _Part:
    """What a kind of strangers says at moments bool [R, K]; where they are too few, when it surprises most."""
    if int(near.sum()) < FEWEST:
        near = said.doubt >= said.doubt.flatten().topk(min(FEWEST, said.doubt.numel())).values[-1]
    unit = said.demonstrated.square() + elsewhere
    return _Part(said.towards[near], said.wanted[near], said.own[near], unit[near])


def _share(kinds: list[_Part]) -> float:
    """The share whose largest regret is least: nobody knows which kind of stranger it is.

    The regret of a kind is its squared error as a multiple of that with the share that would be best for it.
    """
    grid = torch.linspace(0, 1, 21).to(kinds[0].wanted)
    regrets = []
    for part in kinds:
        miss = part.wanted - grid.view(-1, 1, 1, 1) * part.towards
        error = miss.square().nanmean((1, 2, 3))
        regrets.append(error / error.min().clamp(min=1e-12))
    return float(grid[torch.stack(regrets).amax(0).argmin()])


def _widths(kinds: list[_Part], share: Tensor, inflation: Tensor, widening: Tensor) -> tuple[float, float]:
    """c and a of `Doubt`, not below those of a lower level: of pairs that cover the truth that with the least CRPS.

    What is sure of itself and a little wrong needs c, what is lost needs a.
    """
    best = (math.inf, 0.0, 0.0)
    for c in (c for c in INFLATIONS if c >= float(inflation)):
        wider = [part._replace(own=part.own * math.sqrt(1 + c)) for part in kinds]
        a = max(_widening(wider, share), float(widening))
        scores = []
        for part in wider:
            variance = (share * part.own).square() + a * part.unit
            scores.append(gaussian_crps(share * part.towards, variance, part.wanted).nanmean())
        best = min(best, (float(torch.stack(scores).mean()), c, a))
    return best[1:]


def _widening(kinds: list[_Part], share: Tensor) -> float:
    """a of `Doubt`, by which 95 % of all, and 90 % of each kind, lie within 1.96 deviations."""
    needed = []
    for part in kinds:
        miss = (part.wanted - share * part.towards).square() / Z95**2 - (share * part.own).square()
        needed.append((miss / part.unit.clamp(min=1e-12))[~miss.isnan()])
    each = [float(torch.quantile(some, 0.9)) for some in needed if len(some)]
    return max(float(torch.quantile(torch.cat(needed), 0.95)), *each, 0.0)


def _anywhere(primitive: InteractionPrimitive) -> Tensor:
    """[D], variance over all phases of all demonstrations, squared units."""
    table = DemonstrationTable.of(primitive)
    return table.cells[:, :, 0].flatten(0, 1).var(0)
