"""Measurement noise R: the closed form, times what is learned about each DoF and about each part of the phase."""

from __future__ import annotations

from torch import Tensor, nn

from torch_ebip.ambient import owned
from torch_ebip.basis.base import Basis
from torch_ebip.noise.constraints import Positive


class MeasurementNoise(nn.Module):
    """Diagonal R(phase) = start * factor * exp(sum_b context_b(phase) gates_b), all equal to the start at first.

    The last factor depends on phase through a small basis, a column for each modality: it switches modalities
    on and off according to context, the closing wish of the paper, by gradient.

    Args:
        variance: [D] at the start, squared units: a closed form of `InteractionPrimitive`.
        context: functions of phase; default: R does not depend on phase.
        modality_of_dof: int64 [D], needed with ``context``.

    Raises:
        ValueError: a variance that is not positive, or a context without modalities.
    """

    modality_of_dof: Tensor
    gates: nn.Parameter | None

    def __init__(self, variance: Tensor, context: Basis | None = None, modality_of_dof: Tensor | None = None) -> None:
        super().__init__()
        if variance.ndim != 1 or not bool(((variance > 0) & variance.isfinite()).all()):
            raise ValueError(f"variance must be positive, [D], got {tuple(variance.shape)}, min {variance.min()}")
        self.variance = Positive(variance)
        self.context = context
        self.gates = None
        if context is not None:
            if modality_of_dof is None or modality_of_dof.shape != variance.shape:
                raise ValueError(f"a context needs modality_of_dof, int64 [{len(variance)}]")
            self.register_buffer("modality_of_dof", owned(modality_of_dof))
            groups = int(modality_of_dof.max()) + 1
            self.gates = nn.Parameter(owned(variance.new_zeros(context.n_features, groups)))

    @property
    def depends_on_phase(self) -> bool:
        """Whether R changes during an interaction."""
        return self.context is not None

    def log_gate(self, phase: Tensor) -> Tensor:
        """Log of the phase-dependent factor of each modality, [..., M] at phases [...]; zeros at the start."""
        if self.context is None or self.gates is None:
            raise ValueError("this measurement noise has no context: it does not depend on phase")
        gate: Tensor = self.context(phase.clamp(0, 1)) @ self.gates
        return gate

    def forward(self, phase: Tensor | None = None) -> Tensor:
        """Standard deviations [D], or [..., D] at phases [...], in units of the DoFs.

        Raises:
            ValueError: R depends on phase and none is given.
        """
        deviation = self.variance.root
        if self.context is None:
            return deviation
        if phase is None:
            raise ValueError("this measurement noise depends on phase, and the observation has none")
        return deviation * (0.5 * self.log_gate(phase)[..., self.modality_of_dof]).exp()


class SelectedNoise(nn.Module):
    """Some DoFs of a measurement noise, int64 [k], with its parameters: not a copy."""

    dofs: Tensor

    def __init__(self, whole: nn.Module, dofs: Tensor) -> None:
        super().__init__()
        self.whole = whole
        self.register_buffer("dofs", owned(dofs))

    @property
    def depends_on_phase(self) -> bool:
        """Whether R changes during an interaction; assumed of noises that do not say."""
        return bool(getattr(self.whole, "depends_on_phase", True))

    def forward(self, phase: Tensor | None = None) -> Tensor:
        """Standard deviations [k] or [..., k]."""
        deviation: Tensor = self.whole(phase)[..., self.dofs]
        return deviation
