"""Where an ensemble starts."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from torch_ebip.ambient import owned
from torch_ebip.arguments import as_number
from torch_ebip.draws import Generators, integers, standard_normal


class DemonstrationPrior(nn.Module):
    """The demonstrations themselves: the paper's eBIP, step 1 of its algorithm.

    Args:
        states: [N, n], one state a demonstration: phase 0, its phase velocity, its weights.
    """

    states: Tensor

    def __init__(self, states: Tensor) -> None:
        super().__init__()
        check_states(states)
        self.register_buffer("states", owned(states))

    def forward(
        self,
        batch_shape: tuple[int, ...],
        n_members: int,
        members: Tensor | None = None,
        generator: Generators = None,
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
            members = integers(count, shape, self.states.device, generator)
        check_members(members, count)
        return self.states[members.expand(*batch_shape, members.shape[-1]) if batch_shape else members]

    def select(self, columns: Tensor) -> DemonstrationPrior:
        """The prior of some entries of the state, int64 [k]."""
        return DemonstrationPrior(self.states[:, columns])


class MomentPrior(nn.Module):
    """Mean and covariance of the demonstrations' states: the paper's equations of mu_0 and Sigma_0.

    "No initial correlations" between phase and weights, as in the paper; phases all start at 0, so of the block
    Sigma_phi,phi only the variance of the phase velocities is left.

    Args:
        states: [N, n], one state a demonstration: phase 0, its phase velocity, its weights.
        shrinkage: share of the diagonal in the covariance of the weights, (1 - s) C + s diag(C). The sample
            covariance of N demonstrations has rank N - 1 at most; any s > 0 gives it full rank.

    Raises:
        ValueError: fewer than two states, or a shrinkage outside [0, 1].
    """

    states: Tensor

    def __init__(self, states: Tensor, shrinkage: float = 0.0) -> None:
        super().__init__()
        check_states(states)
        as_number("shrinkage", shrinkage, 0, 1)
        self.register_buffer("states", owned(states))
        self.shrinkage = shrinkage

    def forward(self, batch_shape: tuple[int, ...], members: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean [*batch_shape, n] and covariance [*batch_shape, n, n].

        Args:
            batch_shape: leading dimensions.
            members: int64 [..., E], of which demonstrations; broadcast to the batch; default: all.

        Raises:
            ValueError: an index of a demonstration that there is not, or shapes that do not broadcast.
        """
        states = self.states
        if members is not None:
            check_members(members, len(states))
            states = states[members.expand(*batch_shape, members.shape[-1]) if batch_shape else members]
        mean = states.mean(-2)
        anomalies = states - mean.unsqueeze(-2)
        covariance = anomalies.transpose(-1, -2) @ anomalies / (states.shape[-2] - 1)
        variance = covariance.diagonal(dim1=-2, dim2=-1)
        keep = torch.full_like(covariance, 1 - self.shrinkage)
        keep[..., :2, :] = 0
        keep[..., :, :2] = 0
        covariance = covariance * keep
        covariance.diagonal(dim1=-2, dim2=-1).copy_(variance)
        if members is None:
            return mean.expand(*batch_shape, -1), covariance.expand(*batch_shape, -1, -1)
        return mean, covariance

    def extra_repr(self) -> str:
        """The option."""
        return f"shrinkage={self.shrinkage:g}"

    def select(self, columns: Tensor) -> MomentPrior:
        """The prior of some entries of the state, int64 [k]."""
        return MomentPrior(self.states[:, columns], self.shrinkage)


def check_states(states: Tensor) -> None:
    """ValueError unless states are [N, n], N at least 2."""
    if states.ndim != 2 or len(states) < 2:
        raise ValueError(f"a prior needs at least 2 states [N, n], got {tuple(states.shape)}")


def check_members(members: Tensor, count: int) -> None:
    """ValueError unless members are int64 [..., E], indices of ``count`` demonstrations."""
    if not isinstance(members, Tensor):
        raise ValueError(f"members must be a tensor, int64 [..., E], got {type(members).__name__}")
    if members.dtype != torch.int64 or members.ndim < 1:
        raise ValueError(f"members must be int64 [..., E], got {members.dtype} {tuple(members.shape)}")
    if members.numel() and (int(members.min()) < 0 or int(members.max()) >= count):
        raise ValueError(
            f"members must name demonstrations 0 to {count - 1}, got {int(members.min())} to {int(members.max())}"
        )


def select_prior(prior: nn.Module, columns: Tensor) -> nn.Module:
    """The prior of some entries of the state, int64 [k].

    Raises:
        TypeError: a prior that has no ``select``.
    """
    select: Callable[[Tensor], nn.Module] | None = getattr(prior, "select", None)
    if select is None:
        raise TypeError(f"a {type(prior).__name__} cannot be restricted to some DoFs")
    return select(columns)


class GaussianPrior(nn.Module):
    """N(mean [n], covariance [n, n]), positive definite; for models that are not interactions."""

    mean: Tensor
    cholesky: Tensor

    def __init__(self, mean: Tensor, covariance: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", owned(mean))
        self.register_buffer("cholesky", owned(torch.linalg.cholesky(covariance)))

    def forward(
        self,
        batch_shape: tuple[int, ...],
        n_members: int,
        members: Tensor | None = None,
        generator: Generators = None,
    ) -> Tensor:
        """Independent draws [*batch_shape, E, n].

        Args:
            batch_shape: leading dimensions.
            n_members: E.
            members: int64 [..., E] where a prior has demonstrations; this one has none, so None.
            generator: of the draws.
        """
        if members is not None:
            raise ValueError("a Gaussian prior has no demonstrations to choose members from")
        shape = (*batch_shape, n_members, len(self.mean))
        return self.mean + standard_normal(shape, self.mean, generator) @ self.cholesky.T
