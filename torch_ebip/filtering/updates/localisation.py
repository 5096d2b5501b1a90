"""Localisation between modalities: how much of each cross-covariance an update believes."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.functional import Taper
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.noise.constraints import Positive
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.part import Part
from torch_ebip.recordings.layout import Layout


class Localisation(Part):
    """A symmetric factor in [0, 1] for every pair of blocks (modalities, and the phase), learned.

    L = V V' with non-negative rows of unit length, V_i ~ (1, s_i1, ..., s_iM): so L is positive semidefinite
    with ones on its diagonal, and by Schur's theorem a tapered covariance stays one. All s start small and
    different, L a little below 1 everywhere, where gradients exist. s_ii alone large cuts block i off from all
    others; s_ik and s_jk both large keep i and j together and cut them off from the rest.

    Args:
        names: of the M blocks.
        state_block: int64 [n], the block of each entry of the state.
        dof_block: int64 [D], the block of each DoF.
        start: s_ii at the beginning; L starts at about 1 - start^2 between different blocks.
    """

    leaves_span = "covariances are localised"
    state_block: Tensor
    dof_block: Tensor

    def __init__(self, names: tuple[str, ...], state_block: Tensor, dof_block: Tensor, start: float = 0.1) -> None:
        super().__init__()
        self.names = names
        self.register_buffer("state_block", owned(state_block))
        self.register_buffer("dof_block", owned(dof_block))
        own = torch.eye(len(names), device="cpu")
        self.loadings = Positive(start * own + 0.1 * start * (1 - own))

    def extra_repr(self) -> str:
        """The blocks."""
        return f"names={', '.join(self.names)}"

    def check(self, model: StateSpace) -> None:
        """See `Part.check`: it is for as many DoFs as the model has."""
        if len(self.dof_block) != model.n_dofs:
            raise ValueError(f"the localisation is for {len(self.dof_block)} DoFs, the model has {model.n_dofs}")

    def select(self, view: View) -> Localisation:
        """See `Part.select`."""
        part = sharing(self)
        part.register_buffer("state_block", self.state_block[view.state])
        part.register_buffer("dof_block", self.dof_block[view.dofs])
        return part

    def named_values(self, layout: Layout) -> dict[str, float]:
        """See `Part.named_values`: ``localisation/A~B``, the factor between two blocks."""
        matrix = self.matrix
        pairs = [(i, j) for i in range(len(self.names)) for j in range(i + 1, len(self.names))]
        return {f"localisation/{self.names[i]}~{self.names[j]}": float(matrix[i, j]) for i, j in pairs}

    @property
    def matrix(self) -> Tensor:
        """L, [M, M]."""
        loadings = self.loadings.value
        rows = torch.cat([torch.ones_like(loadings[:, :1]), loadings], dim=-1)
        rows = rows / rows.norm(dim=-1, keepdim=True)
        matrix: Tensor = rows @ rows.T
        return matrix

    def forward(self) -> Taper:
        """The factors spread over state and observation: [n, D] and [D, D]."""
        columns = self.matrix[:, self.dof_block]
        return Taper(columns[self.state_block], columns[self.dof_block])
