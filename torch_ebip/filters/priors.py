"""Where an ensemble starts."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip.draws import standard_normal


class DemonstrationPrior(nn.Module):
    """The demonstrations themselves: the paper's eBIP, step 1 of its algorithm.

    Args:
        states: [N, n], one state a demonstration: phase 0, its phase velocity, its weights.
    """

    states: Tensor

    def __init__(self, states: Tensor) -> None:
        super().__init__()
        if states.ndim != 2 or len(states) < 2:
            raise ValueError(f"a prior needs at least 2 states [N, n], got {tuple(states.shape)}")
        self.register_buffer("states", states)

    def forward(
        self,
        batch_shape: tuple[int, ...],
        n_members: int,
        members: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Initial members [*batch_shape, E, n].

        Args:
            batch_shape: leading dimensions.
            n_members: E, used where ``members`` is not given: all demonstrations in their order if E = N,
                otherwise E draws with replacement for each entry of the batch.
            members: int64 [..., E], which demonstrations; broadcast to the batch.
            generator: of the draws.

        Raises:
            ValueError: an index of a demonstration that there is not, or shapes that do not broadcast.
        """
        count = len(self.states)
        if members is None:
            if n_members == count:
                return self.states.expand(*batch_shape, -1, -1)
            shape = (*batch_shape, n_members)
            device = self.states.device if generator is None else generator.device
            members = torch.randint(count, shape, generator=generator, device=device).to(self.states.device)
        if members.dtype != torch.int64 or members.ndim < 1:
            raise ValueError(f"members must be int64 [..., E], got {members.dtype} {tuple(members.shape)}")
        if members.numel() and (int(members.min()) < 0 or int(members.max()) >= count):
            raise ValueError(
                f"members must name demonstrations 0 to {count - 1}, got {int(members.min())} to {int(members.max())}"
            )
        return self.states[members.expand(*batch_shape, members.shape[-1]) if batch_shape else members]

    def select(self, columns: Tensor) -> DemonstrationPrior:
        """The prior of some entries of the state, int64 [k]."""
        return DemonstrationPrior(self.states[:, columns])


class GaussianPrior(nn.Module):
    """N(mean [n], covariance [n, n]), positive definite; for models that are not interactions."""

    mean: Tensor
    cholesky: Tensor

    def __init__(self, mean: Tensor, covariance: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("cholesky", torch.linalg.cholesky(covariance))

    def forward(
        self,
        batch_shape: tuple[int, ...],
        n_members: int,
        members: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Independent draws [*batch_shape, E, n]; ``members`` must be None."""
        if members is not None:
            raise ValueError("a Gaussian prior has no demonstrations to choose members from")
        shape = (*batch_shape, n_members, len(self.mean))
        return self.mean + standard_normal(shape, self.mean, generator) @ self.cholesky.T
