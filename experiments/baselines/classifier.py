"""A recurrent network that says which interaction is going on: what deep learning offers for recognition."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from experiments.baselines.common import until
from experiments.baselines.stretches import all_features, cumulative, features_of, moments
from torch_ebip import Demonstrations

STEPS_SHOWN = 25
"""Stretches of a typical interaction."""
ROUNDS, PATIENCE, EVERY = 400, 8, 20
"""Gradient steps at most; validations without improvement after which training stops; steps between them."""


class _Network(nn.Module):
    """Features [B, S, 3 I] to logits [B, S, L]."""

    def __init__(self, inputs: int, outputs: int, hidden: int = 64) -> None:
        super().__init__()
        self.encode = nn.Linear(3 * inputs, hidden)
        self.recur = nn.GRU(hidden, hidden, batch_first=True)
        self.drop = nn.Dropout(0.3)
        self.out = nn.Linear(hidden, outputs)

    def forward(self, features: Tensor) -> Tensor:
        """See `features_of`."""
        logits: Tensor = self.out(self.drop(self.recur(torch.relu(self.encode(features)))[0]))
        return logits


class RecurrentClassifier:
    """A small GRU, trained when made on every step of every demonstration, stopped early on a fifth left out.

    A temperature that was fitted to that fifth makes its probabilities as right as they can be (Guo et al. 2017).

    Args:
        demonstrations: with labels; of the training part.
        inputs: bool [D], DoFs that are shown.
        seed: of the network, the training and the draws.
        rounds: gradient steps at most.
    """

    def __init__(self, demonstrations: Demonstrations, inputs: Tensor, seed: int = 0, rounds: int = ROUNDS) -> None:
        labels = demonstrations.labels
        assert labels is not None
        self.labels, self.inputs = tuple(dict.fromkeys(labels)), inputs
        self.every = max(1, round(float(demonstrations.lengths.double().median()) / STEPS_SHOWN))
        values, measured = demonstrations.pad()
        values, measured = values[..., inputs].float(), measured[..., inputs]
        self._center, self._scale = moments(values.flatten(0, 1), measured.flatten(0, 1))
        features = all_features((values - self._center) / self._scale, measured, self.every)
        wanted = torch.tensor([self.labels.index(label) for label in labels])
        generator = torch.Generator().manual_seed(seed)
        order = torch.randperm(len(labels), generator=generator)
        held = order[: max(1, len(order) // 5)]
        training = order[len(held) :]
        lengths = demonstrations.lengths
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = _Network(int(inputs.sum()), len(self.labels))
            optimiser = torch.optim.AdamW(network.parameters(), lr=5e-3, weight_decay=1e-2)
            best, best_loss, waited = copy.deepcopy(network), float("inf"), 0
            for step in range(1, rounds + 1):
                network.train()
                chosen = training[torch.randint(len(training), (64,), generator=generator)]
                offset = torch.randint(self.every, (len(chosen),), generator=generator)
                shown = features[offset, chosen]
                shown = shown + 0.02 * torch.randn(shown.shape, generator=generator) * (shown != 0)
                loss = self._loss(network(shown), wanted[chosen], lengths[chosen], offset + 1)
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(network.parameters(), 1.0)
                optimiser.step()
                if step % EVERY == 0:
                    loss = self._held_out(network, features, wanted, lengths, held, 1.0)
                    waited += 1
                    if loss < best_loss:
                        best, best_loss, waited = copy.deepcopy(network), float(loss), 0
                    if waited >= PATIENCE:
                        break
        self._network = best.eval()
        warmth = torch.logspace(-1, 1, 41)
        losses = [float(self._held_out(best, features, wanted, lengths, held, float(t))) for t in warmth]
        self.temperature = float(warmth[losses.index(min(losses))])

    @torch.no_grad()
    def __call__(self, y: Tensor, observed: Tensor, keep: Tensor) -> Tensor:
        """[B, K, L]: probabilities of the labels, from y [B, T, D] where observed, up to samples keep [B, K]."""
        values = (y[..., self.inputs].float() - self._center) / self._scale
        said = []
        for k in range(keep.shape[1]):
            seen = until(observed, keep[:, k])[..., self.inputs]
            stop = keep[:, k] + 1
            first = (stop - 1) % self.every + 1
            last = (stop - first) // self.every
            features = features_of(*cumulative(values, seen), first, int(last.max()) + 1, self.every)
            said.append(self._network(features)[torch.arange(len(y)), last])
        return torch.softmax(torch.stack(said, 1) / self.temperature, -1)

    def _loss(self, logits: Tensor, wanted: Tensor, lengths: Tensor, first: Tensor) -> Tensor:
        """Mean cross-entropy over the steps of interactions, each counting alike."""
        steps = first.unsqueeze(-1) + self.every * torch.arange(logits.shape[1])
        there = (steps <= lengths.unsqueeze(-1)).float()
        losses = nn.functional.cross_entropy(
            logits.flatten(0, 1), wanted.repeat_interleave(logits.shape[1]), reduction="none"
        ).view(there.shape)
        return ((losses * there).sum(1) / there.sum(1).clamp(min=1)).mean()

    @torch.no_grad()
    def _held_out(
        self, network: _Network, features: Tensor, wanted: Tensor, lengths: Tensor, held: Tensor, warmth: float
    ) -> Tensor:
        network.eval()
        first = torch.full_like(held, self.every)
        return self._loss(network(features[self.every - 1, held]) / warmth, wanted[held], lengths[held], first)


def probabilities_of(said: Tensor, labels: Sequence[str], order: Sequence[str]) -> Tensor:
    """Probabilities [..., L] of some labels in another order; labels that are unknown have none."""
    columns = [
        said[..., labels.index(label)] if label in labels else torch.zeros_like(said[..., 0]) for label in order
    ]
    return torch.stack(columns, -1)
