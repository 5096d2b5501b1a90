"""What was measured, for the live path: checked, without looking at values more than is needed."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.filtering.functional.linear import FactorisationError, cholesky
from torch_ebip.filtering.model import StateSpace


def measured_dofs(
    y: Tensor, observed: Tensor | None, like: Tensor, batch_shape: tuple[int, ...], n_dofs: int
) -> tuple[tuple[bool, ...], Tensor | None]:
    """Which DoFs were measured by some entry of the batch; and by which, bool [B, D], if not by all.

    Raises:
        ValueError: wrong shapes, dtypes or devices.
    """
    shape = (*batch_shape, n_dofs)
    if y.dtype != like.dtype or y.device != like.device:
        raise ValueError(f"y must be {like.dtype} on {like.device}, as the filter is, got {y.dtype} on {y.device}")
    if y.shape != shape:
        raise ValueError(f"y must be {list(shape)}, one value for each DoF, got {list(y.shape)}")
    if observed is None:
        observed = y == y  # not where it is NaN
    elif observed.dtype != torch.bool or observed.shape != shape:
        raise ValueError(f"observed must be bool {list(shape)}, got {observed.dtype} {list(observed.shape)}")
    if not batch_shape:
        return tuple(observed.tolist()), None
    some = observed.any(0)
    mask = None if bool((observed == some).all()) else observed
    return tuple(some.tolist()), mask


def explain(S: Tensor, dofs: Tensor, model: StateSpace) -> None:
    """Raise the error of an innovation covariance [..., K, K] of some DoFs int64 [K] that cannot be factored."""
    try:
        cholesky(S, dofs)
    except FactorisationError as error:
        raise model.named(error, None) from error
