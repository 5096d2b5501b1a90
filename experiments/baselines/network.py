"""The recurrent network of the baseline and how it is trained."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class RecurrentSettings:
    """How the networks are built and trained.

    Attributes:
        networks: how many; each leaves another fifth of the training demonstrations out for early stopping.
        hidden: units of the GRU.
        steps_shown: of a typical interaction: as many samples are averaged into one step as that takes.
        dropout: of inputs to the heads.
        hidden_inputs: share of the DoFs shown that are hidden from a batch, others for each demonstration.
        noise: standard deviation of the noise on every input, in deviations of the DoF.
        bias: the same, of a constant for each DoF and recording: a sensor that sits a little differently.
        learning_rate, weight_decay: of AdamW; the rate falls to zero along a cosine.
        batch_size: demonstrations a gradient step, each with sensors and a sampling offset of its own.
        steps: gradient steps at most, of each network.
        validate_every: gradient steps.
        patience: validations without improvement after which training stops.
        earliest: share of an interaction before which forecasts do not count.
        seed: of the networks, the training and the draws.
    """

    networks: int = 2
    hidden: int = 64
    steps_shown: int = 25
    dropout: float = 0.3
    hidden_inputs: float = 0.2
    noise: float = 0.02
    bias: float = 0.02
    learning_rate: float = 5e-3
    weight_decay: float = 1e-2
    batch_size: int = 64
    steps: int = 300
    validate_every: int = 20
    patience: int = 6
    earliest: float = 0.25
    seed: int = 0


@dataclass(frozen=True)
class Data:
    """Training data, standardised.

    Attributes:
        features: [every, N, S, 3 I], see `features_of`; entry o has o + 1 samples in its first stretch.
        lengths: [N] samples.
        futures: [N, T, M], the targets after each sample; NaN where there is nothing to be forecast.
        subsets: bool [subsets, I].
    """

    features: Tensor
    lengths: Tensor
    futures: Tensor
    subsets: Tensor


class Trained(NamedTuple):
    """A network as it was when it served one subset of sensors best, and the factor [M] on its variances there."""

    network: _Network
    variance_factor: Tensor


class _Network(nn.Module):
    """Features [B, S, 3 I] to mean and log-variance [B, S, M], each step from what came up to it."""

    def __init__(self, inputs: int, outputs: int, hidden: int, dropout: float) -> None:
        super().__init__()
        self.encode = nn.Linear(3 * inputs, hidden)
        self.recur = nn.GRU(hidden, hidden, batch_first=True)
        self.drop = nn.Dropout(dropout)
        self.mean = nn.Linear(hidden, outputs)
        self.direct = nn.Linear(3 * inputs, outputs, bias=False)
        self.log_variance = nn.Sequential(nn.Linear(hidden, hidden), nn.Tanh(), nn.Linear(hidden, outputs))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """See `features_of`."""
        hidden, _ = self.recur(torch.relu(self.encode(features)))
        # What is linear in the present, as the path of a ball is, need not go through the GRU.
        mean: Tensor = self.mean(self.drop(hidden)) + self.direct(features)
        log_variance: Tensor = self.log_variance(hidden.detach())
        return mean, log_variance.clamp(-10.0, 5.0)


def train(
    data: Data,
    training: Tensor,
    held_out: Tensor,
    every: int,
    settings: RecurrentSettings,
    seed: int,
    generator: torch.Generator,
) -> list[Trained]:
    """One network, for each subset of sensors as it was when it did best with them on the part held out.

    Some sensors say little and are overfitted long before others are used to the full: one time to stop for all of
    them would be early for the good ones.
    """
    # Initial weights and dropout have no generator of their own; nobody else's draws may change for it.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _Network(data.subsets.shape[-1], data.futures.shape[-1], settings.hidden, settings.dropout)
        optimiser = torch.optim.AdamW(
            network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.steps)
        best = [Trained(copy.deepcopy(network), torch.ones(data.futures.shape[-1])) for _ in data.subsets]
        best_loss, waited = [float("inf")] * len(best), 0
        for step in range(1, settings.steps + 1):
            network.train()
            chosen = training[torch.randint(len(training), (settings.batch_size,), generator=generator)]
            subset = data.subsets[torch.randint(len(data.subsets), (len(chosen),), generator=generator)]
            first = torch.randint(1, every + 1, (len(chosen),), generator=generator)
            subset = subset & (torch.rand(subset.shape, generator=generator) >= settings.hidden_inputs)
            features, target, weight = _batch(data, chosen, subset, first, every, settings.earliest)
            noise = settings.noise * torch.randn(features.shape, generator=generator)
            noise += settings.bias * torch.randn(len(features), 1, features.shape[-1], generator=generator)
            # Zeros are what is not shown or not measured yet: there is no noise without a sensor.
            mean, log_variance = network(features + noise * (features != 0))
            squares = _squares(mean, target)
            likelihood = 0.5 * (log_variance + squares.detach() * torch.exp(-log_variance))
            loss = _average(squares + likelihood, weight, target)
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            schedule.step()
            if step % settings.validate_every == 0 or step == settings.steps:
                waited += 1
                for i, subset in enumerate(data.subsets):
                    error, factor = _held_out(network, data, held_out, subset, every, settings.earliest)
                    if error < best_loss[i]:
                        best_loss[i], waited = error, 0
                        best[i] = Trained(copy.deepcopy(network).eval(), factor)
                if waited >= settings.patience:
                    break
    return best


@torch.no_grad()
def _held_out(
    network: _Network, data: Data, chosen: Tensor, subset: Tensor, every: int, earliest: float
) -> tuple[float, Tensor]:
    """Mean squared error with a subset of sensors, bool [I], and for each target squared error over variance [M]."""
    network.eval()
    first = torch.full_like(chosen, every)
    features, target, weight = _batch(data, chosen, subset.expand(len(chosen), -1), first, every, earliest)
    mean, log_variance = network(features)
    squares = _squares(mean, target)
    weights = weight.unsqueeze(-1) * ~target.isnan()
    ratio = (squares * torch.exp(-log_variance) * weights).sum((0, 1)) / weights.sum((0, 1)).clamp(min=1e-9)
    return float(_average(squares, weight, target)), torch.where(ratio > 0, ratio, 1.0)


def _batch(
    data: Data, chosen: Tensor, subset: Tensor, first: Tensor, every: int, earliest: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Features [B, S, 3 I], targets [B, S, M] and weights [B, S] that sum to one a demonstration.

    Args:
        data: to choose from.
        chosen: demonstrations [B].
        subset: the sensors that each of them shows, bool [B, I].
        first: samples in the first step of each, [B].
        every: samples in the other steps.
        earliest: share of an interaction before which steps have no weight.
    """
    lengths = data.lengths[chosen]
    steps = -(-int(lengths.max()) // every)
    features = data.features[first - 1, chosen, :steps] * subset.repeat(1, 3).unsqueeze(1)
    stops = first.unsqueeze(-1) + every * torch.arange(steps)
    counted = (stops <= lengths.unsqueeze(-1)) & (stops >= earliest * lengths.unsqueeze(-1))
    # Where nothing is measured yet there is nothing to learn but the mean; that is left in, since it is asked for.
    weight = counted / counted.sum(-1, keepdim=True).clamp(min=1)
    last = (torch.minimum(stops, lengths.unsqueeze(-1)) - 1).clamp(min=0)
    return features, data.futures[chosen.unsqueeze(-1), last], weight


def _squares(mean: Tensor, target: Tensor) -> Tensor:
    """Squared errors [B, S, M] of mean [B, S, M] for target [B, S, M], 0 where the target was not measured."""
    return torch.where(target.isnan(), 0.0, mean - target.nan_to_num()).square()


def _average(loss: Tensor, weight: Tensor, target: Tensor) -> Tensor:
    """Mean of loss [B, S, M] over what was measured of target [B, M], steps weighted by [B, S]."""
    weights = weight.unsqueeze(-1) * ~target.isnan()
    return (loss * weights).sum() / weights.sum().clamp(min=1e-9)
