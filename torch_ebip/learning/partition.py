"""Which interactions are tuned on and which decide when to stop; and ensembles that do not know the answer."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.learning.settings import TuningSettings


class Partition:
    """Demonstrations cut into training and validation, and into folds whose ensembles are the other folds.

    Args:
        count: of the demonstrations.
        settings: shares, folds, seed and size of ensembles.

    Attributes:
        training, validating: int64, which demonstrations.
        fold_of: int64 [N], in which fold each is.

    Raises:
        ValueError: fewer than two folds, or too few demonstrations for them: every fold needs one, and an ensemble of
            the others at least two members.
    """

    def __init__(self, count: int, settings: TuningSettings) -> None:
        held = max(1, round(settings.validation * count))
        others = count - -(-count // settings.folds)
        if count - held < 1 or count < settings.folds or others < 2:
            raise ValueError(f"{count} demonstrations are too few for {settings.folds} folds and validation")
        order = torch.randperm(count, generator=torch.Generator("cpu").manual_seed(settings.seed), device="cpu")
        self.validating, self.training = order[:held], order[held:]
        part = torch.empty(count, dtype=torch.long, device="cpu")
        part[order] = torch.arange(count, device="cpu") % settings.folds
        groups = [(part != fold).nonzero().squeeze(-1) for fold in range(settings.folds)]
        size = min(len(group) for group in groups)
        self.fold_of, self._others = part, torch.stack([group[:size] for group in groups])
        self._size = settings.n_members

    @property
    def order(self) -> Tensor:
        """int64 [N], all demonstrations, those that decide when to stop first."""
        return torch.cat([self.validating, self.training])

    def known(self, interactions: Tensor) -> Tensor:
        """bool [B, N], which demonstrations those may know that filter some interactions, int64 [B]."""
        return self.fold_of != self.fold_of[interactions].unsqueeze(-1)

    def members(self, interactions: Tensor, generator: torch.Generator) -> Tensor:
        """Indices [B, E] of demonstrations outside the fold of each of some interactions, int64 [B]."""
        others, size = self._others[self.fold_of[interactions]], self._size
        if size is None or size == others.shape[1]:
            return others
        if size > others.shape[1]:
            return others.gather(
                1, torch.randint(others.shape[1], (len(others), size), generator=generator, device="cpu")
            )
        return others.gather(1, torch.rand(others.shape, generator=generator, device="cpu").argsort(-1)[:, :size])


def generator_of(seed: int, step: int) -> torch.Generator:
    """A generator for each step of a seed; neighbouring steps and seeds do not share streams."""
    return torch.Generator("cpu").manual_seed((seed * 1_000_003 + step * 7_919 + 17) % (2**63))
