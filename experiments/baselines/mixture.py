"""The network of MoVEInt, written anew: a GRU whose output is a mixture of Gaussians (Prasad et al., RA-L 2024).

At every sample it reads what is measured of the human and says what the partner will do in the next few: the mixture
density network of Bishop (1994) on a recurrent state. Without the variational autoencoders of the original, of which
this is the part that forecasts.
"""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor, nn

from experiments.baselines.common import futures
from experiments.baselines.stretches import moments
from torch_ebip import Demonstrations

COMPONENTS, HIDDEN = 3, 64
EPOCHS, VALIDATE_EVERY, PATIENCE = 400, 20, 8


class _Network(nn.Module):
    """Inputs [B, T, I] to log shares [B, T, C], means [B, T, C, O] and log deviations [B, T, C, O]."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.encode = nn.Linear(2 * inputs, HIDDEN)
        self.recur = nn.GRU(HIDDEN, HIDDEN, batch_first=True)
        self.drop = nn.Dropout(0.2)
        self.share = nn.Linear(HIDDEN, COMPONENTS)
        self.mean = nn.Linear(HIDDEN, COMPONENTS * outputs)
        self.deviation = nn.Linear(HIDDEN, COMPONENTS * outputs)

    def forward(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of values and their changes."""
        change = torch.zeros_like(values)
        change[:, 1:] = 10 * (values[:, 1:] - values[:, :-1])
        hidden = self.drop(self.recur(torch.relu(self.encode(torch.cat([values, change], -1))))[0])
        shape = (*hidden.shape[:2], COMPONENTS, -1)
        mean, deviation = self.mean(hidden).view(shape), self.deviation(hidden).view(shape)
        return torch.log_softmax(self.share(hidden), -1), mean, deviation.clamp(-4, 3)


class MixtureNetwork:
    """Trained when made, on every sample of all demonstrations; stopped early on a fifth of them left out.

    Args:
        demonstrations: whose controlled DoFs are forecast from the others.
        ahead: how many samples.
        seed: of the network, the training and the draws.
        epochs: at most.
    """

    def __init__(self, demonstrations: Demonstrations, ahead: int = 5, seed: int = 0, epochs: int = EPOCHS) -> None:
        self.ahead, self.targets = ahead, demonstrations.layout.controlled
        values, measured = demonstrations.pad()
        flat, there = values.flatten(0, 1).float(), measured.flatten(0, 1)
        self._center, self._scale = moments(flat, there)
        standard = ((values.float() - self._center) / self._scale).nan_to_num()
        later = (next_samples(demonstrations, ahead).float() - self._center[self.targets]) / self._scale[self.targets]
        future, counted = later.nan_to_num().flatten(-2), ~later.isnan().any(-1).any(-1)
        inputs = standard[..., ~self.targets]
        generator = torch.Generator().manual_seed(seed)
        order = torch.randperm(len(values), generator=generator)
        held = order[: max(1, len(order) // 5)]
        training = order[len(held) :]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = _Network(inputs.shape[-1], future.shape[-1])
            optimiser = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=1e-3)
            schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, epochs)
            best, best_loss, waited = copy.deepcopy(network), float("inf"), 0
            for epoch in range(1, epochs + 1):
                network.train()
                shown = inputs[training]
                shown = shown + 0.02 * torch.randn(shown.shape, generator=generator)
                loss = _loss(network(shown), future[training], counted[training])
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(network.parameters(), 1.0)
                optimiser.step()
                schedule.step()
                if epoch % VALIDATE_EVERY == 0:
                    network.eval()
                    with torch.no_grad():
                        error = float(_loss(network(inputs[held]), future[held], counted[held]))
                    waited += 1
                    if error < best_loss:
                        best, best_loss, waited = copy.deepcopy(network), error, 0
                    if waited >= PATIENCE:
                        break
        self._network = best.eval()

    @torch.no_grad()
    def __call__(self, y: Tensor) -> Tensor:
        """[B, T, ahead, M], units of the DoFs: what the targets of y [B, T, D] will be, from all samples so far."""
        standard = ((y.float() - self._center) / self._scale).nan_to_num()[..., ~self.targets]
        shares, mean, _ = self._network(standard)
        expected = (shares.exp().unsqueeze(-1) * mean).sum(-2).view(*y.shape[:2], self.ahead, -1)
        return (expected * self._scale[self.targets] + self._center[self.targets]).to(y)


def next_samples(demonstrations: Demonstrations, count: int) -> Tensor:
    """[N, T, count, M], units of the DoFs: the controlled DoFs after each sample; NaN behind the end."""
    longest = int(demonstrations.lengths.max())
    every = torch.arange(longest).expand(len(demonstrations), -1)
    ahead = [k / demonstrations.rate for k in range(1, count + 1)]
    return futures(demonstrations, every, ahead, demonstrations.layout.controlled)


def _loss(said: tuple[Tensor, Tensor, Tensor], future: Tensor, counted: Tensor) -> Tensor:
    """Mean negative log-likelihood of a mixture, per output."""
    shares, mean, log_deviation = said
    z = (future.unsqueeze(-2) - mean) * torch.exp(-log_deviation)
    each = (-0.5 * z.square() - log_deviation - 0.5 * math.log(2 * math.pi)).sum(-1)
    likelihood = torch.logsumexp(shares + each, -1) / future.shape[-1]
    return -(likelihood * counted).sum() / counted.sum()
