"""Linear algebra of covariances: factors that explain why they fail, products in one pass."""

from __future__ import annotations

import torch
from torch import Tensor


def truth(condition: Tensor, instead: str) -> bool:
    """Whether a condition holds, for code that must know.

    Args:
        condition: bool [] or [1].
        instead: what to do without vmap.

    Raises:
        RuntimeError: under `torch.vmap`, where nobody can know.
    """
    try:
        return bool(condition)
    except RuntimeError as error:
        if "vmap" not in str(error):
            raise
        raise RuntimeError(f"torch.vmap cannot look at values; {instead}") from None


class FactorisationError(ValueError):
    """A covariance of observations that is not positive definite.

    Args:
        message: what to say of it.
        dofs: the first failing columns.
    """

    def __init__(self, message: str, dofs: list[int]) -> None:
        super().__init__(message)
        self.dofs = dofs


def cholesky(matrix: Tensor, rows: Tensor | None = None) -> Tensor:
    """Lower Cholesky factor of covariances [..., D, D] of observations, or an error that says what to do.

    Args:
        matrix: [..., D, D], symmetric positive definite.
        rows: int64 [D], which DoFs these are, for the error; default: the first D.

    Raises:
        FactorisationError: names the batch entries and the DoFs.
    """
    factor: Tensor
    factor, info = torch.linalg.cholesky_ex(matrix)
    if truth(info.any(), "updates take batches themselves: give them leading dimensions instead"):
        entries = info.nonzero().tolist() if info.ndim else []
        minors = sorted(set(info[info > 0].reshape(-1).tolist()))
        dofs = [m - 1 if rows is None else int(rows[m - 1]) for m in minors]
        finite = bool(matrix.isfinite().all())
        raise FactorisationError(
            f"a covariance of observations cannot be factored: batch entries {entries[:8] or '[the only one]'}, "
            f"first failing at DoF {dofs[:8]}. "
            + (
                "It is not positive definite: raise the floor of the measurement noise, or use float64."
                if finite
                else "It holds NaN or infinite values: look at the measurements and at the members."
            ),
            dofs,
        )
    return factor


def add_product(base: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """base [..., m, n] + a [..., m, k] @ b [..., k, n] in one pass over the base."""
    if base.ndim == 2:
        return torch.addmm(base, a, b)
    flat = (part.expand(*base.shape[:-2], *part.shape[-2:]).reshape(-1, *part.shape[-2:]) for part in (base, a, b))
    return torch.baddbmm(*flat).reshape(base.shape)
