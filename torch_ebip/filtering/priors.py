"""Where states start that have no demonstrations."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.common.draws import Generators, standard_normal


class GaussianPrior(nn.Module):
    """N(mean [n], covariance [n, n]), positive definite.

    Args:
        mean: [n].
        covariance: [n, n].

    Raises:
        ValueError: a covariance that is not positive definite, or of another size.

    Example:
        >>> import torch
        >>> from torch_ebip import GaussianPrior
        >>> GaussianPrior(torch.zeros(2), torch.eye(2))((3,), 10).shape
        torch.Size([3, 10, 2])
    """

    mean: Tensor
    cholesky: Tensor

    def __init__(self, mean: Tensor, covariance: Tensor) -> None:
        super().__init__()
        n = mean.shape[-1] if mean.ndim == 1 else -1
        if covariance.shape != (n, n):
            raise ValueError(f"mean [n] and covariance [n, n], got {list(mean.shape)} and {list(covariance.shape)}")
        factor, info = torch.linalg.cholesky_ex(covariance)
        if bool(info):
            raise ValueError("the covariance of a Gaussian prior must be positive definite")
        self.register_buffer("mean", owned(mean))
        self.register_buffer("cholesky", owned(factor))

    def forward(
        self,
        batch_shape: tuple[int, ...],
        n_members: int,
        chosen: Tensor | None = None,
        generator: Generators = None,
    ) -> Tensor:
        """Independent draws [*batch_shape, E, n].

        Args:
            batch_shape: leading dimensions.
            n_members: E.
            chosen: int64 [..., E] where a prior has states to choose from; this one has none, so None.
            generator: of the draws.
        """
        if chosen is not None:
            raise ValueError("a Gaussian prior has no demonstrations to choose members from")
        shape = (*batch_shape, n_members, len(self.mean))
        return self.mean + standard_normal(shape, self.mean, generator) @ self.cholesky.T
