"""Training of the recurrent expert: networks for all sets of sensors, and the same without each fold.

All are trained at once, as one batch of networks. Every step shows each moment with one of the sets of sensors, some
of their DoFs hidden and noise on all of them, so that the networks read what there is and lean on nothing; that, few
units and few steps are what keeps them from knowing a few hundred interactions by heart.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.filtering.updates.recent import Recent
from torch_ebip.interaction.expert import Expert, Layers
from torch_ebip.interaction.table import DemonstrationTable
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.partition import generator_of
from torch_ebip.learning.recently import recent_sums

EARLIEST, MOMENTS = 0.15, 40
"""Share of an interaction from which on it is read, and at how many moments."""
FEWEST = 50
"""Demonstrations below which networks would only know them by heart."""
STEPS = 300
"""Of the gradient."""
ROWS = 256
"""Moments a step, of each network."""
RATE, DECAY = 5e-3, 1e-2
"""Of AdamW; the rate falls to zero along a cosine."""
HIDDEN_INPUTS, DROPOUT = 0.2, 0.3
"""Shares of the DoFs and of the units that are left out."""
NOISE, BIAS = 0.05, 0.05
"""Deviations of the noise on each input, and of one that all inputs of a DoF have in common."""
STILL = 1e30
"""In place of the deviation of a DoF that never moved: it says nothing then."""


@without_autocast
def fit_experts(expert: Expert, held_out: HeldOut, recent: Recent, interactions: Tensor) -> list[Expert]:
    """Train the networks of an expert.

    Args:
        expert: changed.
        held_out: the demonstrations, and what is asked of them: the expert's horizons.
        recent: remembers the expert's windows.
        interactions: int64 [B], that are read.

    Returns:
        For each fold the same, trained without it.
    """
    interactions = interactions.to(held_out.lengths.device)
    _standardise(expert, held_out, interactions)
    inputs, truth = _read(expert, held_out, recent, interactions)
    fold = held_out.partition.fold_of.to(interactions.device)[interactions]
    everything = torch.ones_like(fold, dtype=torch.bool)
    pools = [fold != f for f in range(held_out.settings.folds)]
    # What is trained without a fold that holds all is never asked.
    pools = [(pool if bool(pool.any()) else everything).nonzero().squeeze(-1) for pool in [*pools, everything]]
    experts = [copy.deepcopy(expert) for _ in pools[:-1]]
    every = [*experts, expert]
    for each, pool in zip(every, pools, strict=True):
        each.centre.copy_(truth[pool].flatten(0, 1).nanmean(0).nan_to_num())
    centres = torch.stack([each.centre for each in every])[:, None]  # [G, 1, K, T]
    found = _train(expert, held_out, inputs, truth, centres, pools)
    for g, each in enumerate(every):
        for name, weights in found._asdict().items():
            getattr(each, name).copy_(weights.unflatten(0, (len(every), -1))[g])
    return experts


def _standardise(expert: Expert, held_out: HeldOut, interactions: Tensor) -> None:
    """Give an expert the middle and the scale of what it reads and of what it says."""
    primitive = held_out.task.primitive
    table, seen = DemonstrationTable.of(primitive), expert.seen
    velocity = table.slopes[..., seen] * primitive.phase_velocity[:, None, None]
    deviations = torch.stack(
        [primitive.value_variance[seen].clamp(min=0).sqrt(), velocity[interactions].flatten(0, 1).std(0)]
    )
    expert.middle.copy_(table.values[interactions][..., seen].mean((0, 1)))
    expert.scale.copy_(torch.where((deviations > 0) & (deviations[:1] > 0), deviations, STILL))
    expert.unit.copy_(held_out.task.objective.scale.expand_as(expert.unit))


def _read(expert: Expert, held_out: HeldOut, recent: Recent, interactions: Tensor) -> tuple[Tensor, Tensor]:
    """Inputs [B, MOMENTS, k, C] of all sensors, and what then came, [B, MOMENTS, K, T]; NaN: not measured."""
    task = held_out.task
    assert task.objective.ahead is not None
    shares = torch.linspace(EARLIEST, 1, MOMENTS, device=interactions.device)
    steps = (shares * (held_out.lengths[interactions] - 1).unsqueeze(-1)).round().long()
    shown = torch.zeros(task.primitive.layout.n_dofs, dtype=torch.bool, device=interactions.device)
    shown[expert.seen] = True
    y, observed = held_out.values[interactions], held_out.observed[interactions] & shown
    sums = recent_sums(recent, y, observed, steps, 1 / task.primitive.rate)
    return expert.inputs(recent.lines(sums)), held_out.recorded(interactions, steps, task.objective.ahead)


def _train(
    expert: Expert, held_out: HeldOut, inputs: Tensor, truth: Tensor, centres: Tensor, pools: list[Tensor]
) -> Layers:
    """Networks [G M, ...], M for each of G pools of interactions, whose truth has these centres."""
    draws = generator_of(held_out.settings.seed, -7)
    n, R, k = len(pools) * expert.networks, ROWS, inputs.shape[-2]

    def uniform(*shape: int) -> Tensor:
        """Draws from [0, 1)."""
        return torch.rand(shape, generator=draws, device="cpu").to(inputs)

    def normal(*shape: int) -> Tensor:
        """Draws of deviation 1."""
        return torch.randn(shape, generator=draws, device="cpu").to(inputs)

    layers = _started(expert, n, uniform)
    sets = torch.stack([mask[expert.seen] for mask in held_out.task.subsets.values()]).to(inputs)  # [S, k]
    sizes = torch.tensor([len(pool) for pool in pools], device=inputs.device)
    pool = torch.nn.utils.rnn.pad_sequence(pools, batch_first=True)
    # A row of each of these for a network.
    sizes, pool, centres = (each.repeat_interleave(expert.networks, 0) for each in (sizes, pool, centres))
    optimiser = torch.optim.AdamW(layers, lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        # Draws are below 1, but their product may be rounded up.
        rows = pool.gather(1, torch.minimum((uniform(n, R) * sizes[:, None]).long(), sizes[:, None] - 1))
        moments = (uniform(n, R) * MOMENTS).long().clamp(max=MOMENTS - 1)
        which = (uniform(n, R) * len(sets)).long().clamp(max=len(sets) - 1)
        shown = sets[which] * (uniform(n, R, k) >= HIDDEN_INPUTS)
        x = inputs[rows, moments]  # [n, R, k, C]
        noise = NOISE * normal(*x.shape) + BIAS * normal(*x.shape[:-1], 1)
        # Zeros are what is not measured: there is no noise without a sensor.
        x = (x + noise * (x != 0)) * shown.unsqueeze(-1)
        keep = (uniform(n, R, expert.hidden) >= DROPOUT) / (1 - DROPOUT)
        with torch.enable_grad():
            said = layers.read(x.flatten(-2), keep).view(n, R, *truth.shape[-2:])
            wanted = (truth[rows, moments] - centres) / expert.unit
            counts = ~wanted.isnan()
            squares = torch.where(counts, said - wanted.nan_to_num(), 0).square()
            # Each horizon counts alike, however many interactions reach it; networks do not know of each other.
            loss = (squares.sum((1, 3)) / counts.sum((1, 3)).clamp(min=1)).mean(-1).sum()
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
        _clip(layers)
        optimiser.step()
        schedule.step()
    return Layers(*(weights.detach() for weights in layers))


def _started(expert: Expert, networks: int, uniform: Callable[..., Tensor]) -> Layers:
    """Random weights, of each layer within 1 / sqrt(its inputs); biases of 0."""
    started = []
    for name, weights in expert.layers._asdict().items():
        shape = (networks, *weights.shape[1:])
        size = 0.0 if name.endswith("bias") else 1 / math.sqrt(shape[-2])
        started.append(((2 * uniform(*shape) - 1) * size).requires_grad_())
    return Layers(*started)


def _clip(layers: Layers) -> None:
    """Hold the gradient of each network within a length of 1; one that is not finite changes nothing."""
    gradients = [weights.grad for weights in layers if weights.grad is not None]
    length = torch.stack([gradient.square().sum((-2, -1)) for gradient in gradients]).sum(0).sqrt()
    factor = torch.where(length.isfinite(), 1 / length.clamp(min=1), 0)[..., None, None]
    for gradient in gradients:
        gradient.copy_(torch.where(factor > 0, gradient * factor, 0))
