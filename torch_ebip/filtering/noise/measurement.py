"""Measurement noise R: a variance for each DoF, from a closed form on, learned as a factor on it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.filtering.noise.constraints import Positive
from torch_ebip.recordings.layout import Layout

if TYPE_CHECKING:
    from torch_ebip.filtering.protocols import View


@runtime_checkable
class SaysWhatItDependsOn(Protocol):
    """A measurement noise that says whether it changes with the state; assumed of those that do not say."""

    @property
    def depends_on_state(self) -> bool:
        """Whether R changes during a sequence."""


class MeasurementNoise(nn.Module):
    """Diagonal R = start * factor, equal to the start at first.

    Args:
        variance: [D] at the start, squared units.

    Raises:
        ValueError: a variance that is not positive.

    Example:
        >>> import torch
        >>> from torch_ebip import MeasurementNoise
        >>> MeasurementNoise(torch.tensor([0.04, 1.0]))().tolist()
        [0.20000000298023224, 1.0]
    """

    def __init__(self, variance: Tensor) -> None:
        super().__init__()
        if variance.ndim != 1 or not bool(((variance > 0) & variance.isfinite()).all()):
            raise ValueError(f"variance must be positive, [D], got {tuple(variance.shape)}, min {variance.min()}")
        self.variance = Positive(variance)

    @property
    def depends_on_state(self) -> bool:
        """Whether R changes during a sequence: no."""
        return False

    def forward(self, moving: Tensor | None = None) -> Tensor:
        """Standard deviations [D], units of the DoFs, whatever the mean [..., m] of what moves."""
        return self.variance.root

    def named_values(self, layout: Layout) -> dict[str, float]:
        """What TensorBoard shows of it for the DoFs of a layout.

        ``R/MODALITY`` is the geometric mean over its DoFs of the standard deviation, in its unit, ``R_factor/DOF``
        the variance relative to the start.
        """
        variance = self.variance.value
        factor = variance / self.variance.start
        values = {f"R_factor/{dof}": value for dof, value in zip(layout.dofs, factor.tolist(), strict=True)}
        for modality in layout.modalities:
            part = layout.slice(modality.name)
            values[f"R/{modality.name}"] = float((0.5 * variance[part].log().mean()).exp())
        return values


class SelectedNoise(nn.Module):
    """The measurement noise of a view of a model, with its parameters, not copies of them.

    A sample that stands for k has the mean of their noise: R is divided by the stride.

    Args:
        whole: maps the mean of what moves to standard deviations of all DoFs.
        view: which DoFs, how many samples each one stands for.
    """

    dofs: Tensor

    def __init__(self, whole: nn.Module, view: View) -> None:
        super().__init__()
        self.whole = whole
        self.stride = view.stride
        self.register_buffer("dofs", owned(view.dofs))

    @property
    def depends_on_state(self) -> bool:
        """Whether R changes during a sequence; assumed of noises that do not say."""
        return self.whole.depends_on_state if isinstance(self.whole, SaysWhatItDependsOn) else True

    def forward(self, moving: Tensor | None = None) -> Tensor:
        """Standard deviations [k] or [..., k] at the mean [..., m] of what moves."""
        deviation: Tensor = self.whole(moving)[..., self.dofs] / math.sqrt(self.stride)
        return deviation
