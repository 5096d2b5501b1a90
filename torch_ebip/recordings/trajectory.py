"""One recording as it is handed in, checked."""

from __future__ import annotations

import numpy.typing as npt
from torch import Tensor

from torch_ebip.common.ambient import outside_inference, own_modes
from torch_ebip.common.arguments import as_values
from torch_ebip.recordings.layout import Layout


def checked(index: int, given: Tensor | npt.ArrayLike, layout: Layout) -> Tensor:
    """A trajectory [T, D] of a layout.

    Args:
        index: of the demonstration, for errors.
        given: tensor, array, lists or a data frame, [T, D], units of the DoFs.
        layout: what its columns are.

    Raises:
        ValueError: it is not [T >= 2, D], has no measured value, or an infinite one.
    """
    name = f"demonstration {index}"
    with own_modes(inference=True):
        trajectory = outside_inference(as_values(name, given, layout.dofs).detach())
    if trajectory.ndim != 2 or trajectory.shape[1] != layout.n_dofs:
        raise ValueError(
            f"{name} has shape {tuple(trajectory.shape)}, expected [T, {layout.n_dofs}]: one column for each of "
            f"{', '.join(layout.names)}"
        )
    if len(trajectory) < 2:
        raise ValueError(f"{name} has {len(trajectory)} samples, at least 2 are needed")
    if trajectory.isnan().all():
        raise ValueError(f"{name} has no measured value: all of it is NaN")
    if trajectory.isinf().any():
        dof = layout.dofs[int(trajectory.isinf().any(0).nonzero()[0])]
        raise ValueError(f"{name} has infinite values in {dof}; mark what was not measured as NaN")
    return trajectory
