"""What callers hand a filter, checked before anything is computed."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.common.ambient import outside_inference
from torch_ebip.common.arguments import as_values
from torch_ebip.common.draws import Generators
from torch_ebip.filtering.functional.linear import truth
from torch_ebip.filtering.states import State, map_state


def usable(state: State) -> State:
    """The state, a copy if it was made in inference mode and is used outside of it."""
    return map_state(outside_inference, state) if state[0].is_inference() else state


def as_sample(
    y: Tensor, observed: Tensor | None, n_dofs: int, names: tuple[str, ...] | None, like: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Measurements [..., D] and where they are, bool [..., D].

    Args:
        y: [..., D], tensor, array or list.
        observed: bool [..., D]; default: where y is not NaN.
        n_dofs: D.
        names: of the DoFs, by which columns of a data frame are taken.
        like: in whose dtype and on whose device they are to be; default: as they are.

    Raises:
        ValueError: wrong shapes or dtypes; NaN or infinity where observed.
    """
    y = outside_inference(as_values("y", y, names, like))
    if y.shape[-1:] != (n_dofs,):
        raise ValueError(f"y must end in {n_dofs}, one value for each DoF, got {tuple(y.shape)}")
    if observed is not None and not isinstance(observed, Tensor):
        observed = torch.as_tensor(observed, device=y.device)
    if observed is None:
        observed = ~y.isnan()
    elif observed.dtype != torch.bool or observed.shape[-1:] != (n_dofs,):
        raise ValueError(f"observed must be bool and end in {n_dofs}, got {observed.dtype} {tuple(observed.shape)}")
    bad = observed & ~y.isfinite()
    if truth(bad.any(), "a filter takes batches itself: give it y [..., T, D] instead"):
        columns = bad.reshape(-1, n_dofs).any(0).nonzero().squeeze(-1).tolist()
        raise ValueError(f"y is NaN or infinite where it is observed, in DoFs {columns[:8]}; mark it False there")
    return y, observed.expand(y.shape)


def check_sequence(y: Tensor, generator: Generators, keep: Tensor | None) -> None:
    """ValueError unless a sequence y [..., T, D] has samples, a generator for each entry, and the steps to keep."""
    if y.ndim < 2 or y.shape[-2] < 1:
        raise ValueError(f"y must be [..., T, {y.shape[-1]}] with at least one sample, got {tuple(y.shape)}")
    batch, length = y.shape[:-2], y.shape[-2]
    if generator is not None and not isinstance(generator, torch.Generator) and len(generator) != (*batch, 0)[0]:
        raise ValueError(f"{len(generator)} generators for a batch {list(batch)}: needs one for each entry")
    if keep is not None:
        whole = not keep.is_floating_point() and keep.shape[:-1] == batch and keep.numel() > 0
        if not whole or int(keep.min()) < 0 or int(keep.max()) >= length:
            shape = ", ".join(map(str, batch))
            raise ValueError(f"keep must be [{shape}, K] with steps 0..{length - 1}, got {keep}")
