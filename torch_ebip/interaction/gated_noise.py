"""Measurement noise that depends on where in the interaction one is."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.filtering.noise.measurement import MeasurementNoise
from torch_ebip.interaction.basis.base import Basis
from torch_ebip.recordings.layout import Layout


class PhaseGatedNoise(MeasurementNoise):
    """Diagonal R(phase) = start * factor * exp(sum_b context_b(phase) gates_b), all equal to the start at first.

    The last factor depends on phase through a small basis, a column for each modality: it switches modalities
    on and off according to context, the closing wish of the paper, by gradient.

    Args:
        variance: [D] at the start, squared units: a closed form of `InteractionPrimitive`.
        context: functions of phase.
        modality_of_dof: int64 [D].

    Raises:
        ValueError: a variance that is not positive, or modalities of another length.
    """

    modality_of_dof: Tensor

    def __init__(self, variance: Tensor, context: Basis, modality_of_dof: Tensor) -> None:
        super().__init__(variance)
        if modality_of_dof.shape != variance.shape:
            raise ValueError(f"a context needs modality_of_dof, int64 [{len(variance)}]")
        self.context = context
        self.register_buffer("modality_of_dof", owned(modality_of_dof))
        groups = int(modality_of_dof.max()) + 1
        self.gates = nn.Parameter(owned(variance.new_zeros(context.n_features, groups)))

    @property
    def depends_on_state(self) -> bool:
        """Whether R changes during an interaction: yes."""
        return True

    def log_gate(self, phase: Tensor) -> Tensor:
        """Log of the phase-dependent factor of each modality, [..., M] at phases [...]; zeros at the start."""
        gate: Tensor = self.context(phase.clamp(0, 1)) @ self.gates
        return gate

    def forward(self, moving: Tensor | None = None) -> Tensor:
        """Standard deviations [..., D], units of the DoFs, at a mean [..., m] of what moves, the phase first.

        Raises:
            ValueError: none is given.
        """
        if moving is None:
            raise ValueError("this measurement noise depends on phase, and none is given")
        gate = self.log_gate(moving[..., 0])[..., self.modality_of_dof]
        return super().forward() * (0.5 * gate).exp()

    def named_values(self, layout: Layout) -> dict[str, float]:
        """See `MeasurementNoise.named_values`; and ``R_phase/MODALITY/PHASE``, the factor on the variance there."""
        values = super().named_values(layout)
        phases = torch.linspace(0, 1, 5, dtype=self.gates.dtype, device=self.gates.device)
        gates = self.log_gate(phases).exp()
        for i, modality in enumerate(layout.modalities):
            for phase, gate in zip(phases.tolist(), gates[:, i].tolist(), strict=True):
                values[f"R_phase/{modality.name}/{phase:.2f}"] = gate
        return values
