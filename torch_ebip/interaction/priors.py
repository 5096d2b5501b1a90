"""Where an interaction starts: at its demonstrations, or at their moments."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_number
from torch_ebip.common.draws import Generators, integers
from torch_ebip.common.modules import FastTwins, sharing
from torch_ebip.filtering.protocols import View


class DemonstrationPrior(FastTwins, nn.Module):
    """The demonstrations themselves: the paper's eBIP, step 1 of its algorithm.

    Args:
        states: [N, n], one state a demonstration: phase 0, its phase velocity, its weights.
    """

    twins: ClassVar[dict[str, tuple[str, ...]]] = {"forward": ("start",)}
    states: Tensor

    def __init__(self, states: Tensor) -> None:
        super().__init__()
        check_states(states)
        self.register_buffer("states", owned(states))

    def forward(
        self,
        batch_shape: tuple[int, ...],
        n_members: int,
        chosen: Tensor | None = None,
        generator: Generators = None,
    ) -> Tensor:
        """Initial members [*batch_shape, E, n]; see `start`, of which they are the first half.

        Args:
            batch_shape: leading dimensions.
            n_members: E.
            chosen: int64 [..., E].
            generator: of the draws.
        """
        return self._started(batch_shape, n_members, chosen, generator)[0]

    def start(
        self, batch_shape: tuple[int, ...], n_members: int, chosen: Tensor | None, generator: Generators
    ) -> tuple[Tensor, Tensor]:
        """Initial members [*batch_shape, E, n], and which demonstration each of them is, int64 [*batch_shape, E].

        Args:
            batch_shape: leading dimensions.
            n_members: E, used where nothing is chosen: all demonstrations in their order if E = N,
                otherwise E draws with replacement for each entry of the batch.
            chosen: int64 [..., E], which demonstrations; broadcast to the batch.
            generator: of the draws.

        Raises:
            ValueError: an index of a demonstration that there is not, or shapes that do not broadcast.
        """
        return self._started(batch_shape, n_members, chosen, generator)

    def _started(
        self, batch_shape: tuple[int, ...], n_members: int, chosen: Tensor | None, generator: Generators
    ) -> tuple[Tensor, Tensor]:
        count = len(self.states)
        if chosen is None:
            if n_members == count:
                origin = torch.arange(count, device=self.states.device)
                return self.states.expand(*batch_shape, -1, -1), origin.expand(*batch_shape, -1)
            chosen = integers(count, (*batch_shape, n_members), self.states.device, generator)
        check_members(chosen, count)
        origin = chosen.expand(*batch_shape, chosen.shape[-1]) if batch_shape else chosen
        return self.states[origin], origin

    def select(self, view: View) -> DemonstrationPrior:
        """The prior of a view of the model."""
        part = sharing(self)
        part.register_buffer("states", self.states[:, view.state])
        return part


class MomentPrior(nn.Module):
    """Mean and covariance of the demonstrations' states: the paper's equations of mu_0 and Sigma_0.

    "No initial correlations" between phase and weights, as in the paper; phases all start at 0, so of the block
    Sigma_phi,phi only the variance of the phase velocities is left.

    Args:
        states: [N, n], one state a demonstration: phase 0, its phase velocity, its weights.
        shrinkage: share of the diagonal in the covariance of the weights, (1 - s) C + s diag(C). The sample
            covariance of N demonstrations has rank N - 1 at most; any s > 0 gives it full rank.
        moving: m, how many entries of a state come before the weights.

    Raises:
        ValueError: fewer than two states, or a shrinkage outside [0, 1].
    """

    states: Tensor

    def __init__(self, states: Tensor, shrinkage: float = 0.0, moving: int = 2) -> None:
        super().__init__()
        check_states(states)
        as_number("shrinkage", shrinkage, 0, 1)
        self.register_buffer("states", owned(states))
        self.shrinkage = shrinkage
        self.moving = moving

    @property
    def leaves_span(self) -> str | None:
        """Why means leave the span of the demonstrations, if they do."""
        return "the prior covariance is shrunk" if self.shrinkage else None

    def forward(self, batch_shape: tuple[int, ...], chosen: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean [*batch_shape, n] and covariance [*batch_shape, n, n].

        Args:
            batch_shape: leading dimensions.
            chosen: int64 [..., E], of which demonstrations; broadcast to the batch; default: all.

        Raises:
            ValueError: an index of a demonstration that there is not, or shapes that do not broadcast.
        """
        states = self.states
        if chosen is not None:
            check_members(chosen, len(states))
            states = states[chosen.expand(*batch_shape, chosen.shape[-1]) if batch_shape else chosen]
        mean = states.mean(-2)
        anomalies = states - mean.unsqueeze(-2)
        covariance = anomalies.transpose(-1, -2) @ anomalies / (states.shape[-2] - 1)
        variance = covariance.diagonal(dim1=-2, dim2=-1)
        keep = torch.full_like(covariance, 1 - self.shrinkage)
        keep[..., : self.moving, :] = 0
        keep[..., :, : self.moving] = 0
        covariance = covariance * keep
        covariance.diagonal(dim1=-2, dim2=-1).copy_(variance)
        if chosen is None:
            return mean.expand(*batch_shape, -1), covariance.expand(*batch_shape, -1, -1)
        return mean, covariance

    def extra_repr(self) -> str:
        """The option."""
        return f"shrinkage={self.shrinkage:g}"

    def select(self, view: View) -> MomentPrior:
        """The prior of a view of the model."""
        part = sharing(self)
        part.register_buffer("states", self.states[:, view.state])
        return part


def check_states(states: Tensor) -> None:
    """ValueError unless states are [N, n], N at least 2."""
    if states.ndim != 2 or len(states) < 2:
        raise ValueError(f"a prior needs at least 2 states [N, n], got {tuple(states.shape)}")


def check_members(chosen: Tensor, count: int) -> None:
    """ValueError unless what is chosen is int64 [..., E], indices of ``count`` demonstrations."""
    if not isinstance(chosen, Tensor):
        raise ValueError(f"demonstrations must be a tensor, int64 [..., E], got {type(chosen).__name__}")
    if chosen.dtype != torch.int64 or chosen.ndim < 1:
        raise ValueError(f"demonstrations must be int64 [..., E], got {chosen.dtype} {tuple(chosen.shape)}")
    if chosen.numel() and (int(chosen.min()) < 0 or int(chosen.max()) >= count):
        raise ValueError(
            f"demonstrations must be numbered 0 to {count - 1}, got {int(chosen.min())} to {int(chosen.max())}"
        )
