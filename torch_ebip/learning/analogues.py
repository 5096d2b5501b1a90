"""What near means to analogues: from interactions left out.

The parameters of the kernel are few, and tuned by gradient on what the analogues alone say of interactions that are
none of them. They are the same for all sets of sensors that are shown, so that they serve others, too. What analogues
are worth is asked of kernels that were tuned without the interactions that are asked about, fold by fold.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import without_autocast
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.states import map_state
from torch_ebip.interaction.analogues import PORTION, Analogues
from torch_ebip.interaction.present import Present
from torch_ebip.interaction.readout import Lead
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.partition import generator_of
from torch_ebip.learning.said import Said

FEWEST = 20
"""Demonstrations below which nothing can be said of what near means."""
MOMENTS = 10
"""Of each interaction."""
STEPS = 50
"""Of the gradient."""
ROWS = 96
"""Moments a step."""
RATE = 0.1
"""Of Adam, at first; it falls along a half cosine."""
PULL = 1e-3
"""Weight of the squared distance of the parameters from where they start."""
LIKELIHOOD = 0.1
"""Weight of the likelihood beside the error: the spread of the analogues should tell theirs."""


def moments_of(held_out: HeldOut) -> Tensor:
    """[K], shares of an interaction at which its present is compared: within the settings' horizons, and before.

    At first nothing is known but where all begins: of that read-outs learn how wide they must be then.
    """
    low, high = held_out.settings.horizons
    first = torch.tensor([0.0, low / 2], device="cpu")
    return torch.cat([first, torch.linspace(low, min(high + 0.02, 1.0), MOMENTS - 2, device="cpu")])


@without_autocast
def fit_analogues(analogues: Analogues, held_out: HeldOut, said: Said) -> list[Analogues]:
    """Tune the kernel of analogues over all targets.

    Args:
        analogues: changed.
        held_out: the demonstrations, and what is asked of them: seconds ahead.
        said: by a filter that remembers what was seen of late; by what it knew of the present.

    Returns:
        For each fold the same, tuned without it.
    """
    fold = fold_of(held_out, said)
    without = [copy.deepcopy(analogues) for _ in range(held_out.settings.folds)]
    for f, each in enumerate(without):
        _tune(each, held_out, said, fold != f)
    _tune(analogues, held_out, said, torch.ones_like(fold, dtype=torch.bool))
    return without


def _tune(analogues: Analogues, held_out: HeldOut, said: Said, some: Tensor) -> None:
    """Tune a kernel on ``some``, bool [R], of what was said."""
    assert said.present is not None
    if not bool(some.any()):  # a fold that holds all: it is as it was
        return
    scale, head = held_out.task.objective.scale, _of_targets(held_out, analogues)
    truth = (said.wanted + said.mean)[some].flatten(0, 1)  # [RK, P, D], units of the scale
    present: Present = map_state(lambda part: part[some].flatten(0, 1), said.present)
    lead = _lead(held_out)
    often = (~truth.isnan()).to(scale).mean((0, 2)).clamp(min=1e-6)
    # Between them the variance of the analogues becomes one of forecasts; not kept.
    spread = nn.Parameter(scale.new_tensor([0.0, -2.0]))
    learned = [parameter for parameter in analogues.parameters() if parameter.requires_grad]
    optimiser = torch.optim.Adam([*learned, spread], lr=RATE)
    draws = generator_of(held_out.settings.seed, -5)
    for step in range(STEPS):
        optimiser.param_groups[0]["lr"] = RATE * 0.5 * (1 + math.cos(math.pi * step / STEPS)) + 0.03 * RATE
        rows = torch.randint(len(truth), (ROWS,), generator=draws, device="cpu").to(truth.device)
        now: Present = map_state(lambda part, rows=rows: part[rows], present)
        with torch.enable_grad():
            mean, variance = head.forecast(head(now), lead)
            mean, variance = mean / scale, variance / scale.square()
            measured = ~truth[rows].isnan()
            error = torch.where(measured, truth[rows], mean.detach()) - mean
            wide = variance * spread[0].exp() + spread[1].exp()
            terms = 2 * ((1 + error.square()).sqrt() - 1) + LIKELIHOOD * (error.square() / wide + wide.log())
            loss = (torch.where(measured, terms, 0).mean((0, 2)) / often).mean()
            loss = loss + PULL * sum(parameter.square().sum() for parameter in learned)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
        # One absurd moment is no reason to forget what the others taught.
        if bool(nn.utils.clip_grad_norm_([*learned, spread], 2.0).isfinite()):
            optimiser.step()
    optimiser.zero_grad()


@without_autocast
@torch.no_grad()
def what_analogues_say(held_out: HeldOut, without: Sequence[Analogues], said: Said) -> tuple[Tensor, Tensor]:
    """What analogues say less the mean, and their deviation, [R, K, P, D] of the targets, in units of the scale.

    Args:
        held_out: the demonstrations, and what is asked of them: seconds ahead.
        without: tuned without each fold, which they speak of, see `fit_analogues`.
        said: by a filter that remembers what was seen of late; by what it knew of the present.
    """
    fold = fold_of(held_out, said)
    lead, scale = _lead(held_out), held_out.task.objective.scale
    portion = max(1, PORTION // (said.place[0, ..., 0].numel() * len(without[0].pace) * scale.shape[-1]))
    mean, variance = torch.empty_like(said.mean), torch.empty_like(said.mean)
    for f, analogues in enumerate(without):
        head = _of_targets(held_out, analogues)
        for rows in torch.split((fold == f).nonzero().squeeze(-1), portion):
            present: Present = map_state(lambda part, rows=rows: part[rows], said.present)
            mean[rows], variance[rows] = head.forecast(head(present), lead)
    return mean / scale - said.mean, variance.clamp(min=0).sqrt() / scale


def fold_of(held_out: HeldOut, said: Said) -> Tensor:
    """int64 [R], of what was ``said``."""
    return held_out.partition.fold_of.to(said.interaction.device)[said.interaction]


def _of_targets(held_out: HeldOut, analogues: Analogues) -> Analogues:
    """The analogues of a task's targets."""
    dofs = held_out.task.targets.nonzero().squeeze(-1)
    return analogues.select(View(dofs, dofs))


def _lead(held_out: HeldOut) -> Lead:
    """Of forecasts that are asked for by seconds: nothing else of it is looked at."""
    ahead = held_out.task.objective.ahead
    assert ahead is not None
    nothing = torch.zeros_like(ahead)
    return Lead(nothing, nothing, nothing, nothing, ahead)
