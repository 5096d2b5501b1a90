"""One basis for each DoF: the paper's observation function h(phi, w)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import without_autocast
from torch_ebip.common.arguments import as_mask
from torch_ebip.interaction.basis.base import Basis


class _Run(NamedTuple):
    """Neighbouring DoFs with equal bases: which basis, which DoFs, which weights."""

    basis: int
    dofs: slice
    weights: slice

    def wanted(self, dofs: Sequence[int] | None) -> list[int]:
        """Which of the run's DoFs are among some, ascending indices (None for all), counted from its first."""
        if dofs is None:
            return list(range(self.dofs.stop - self.dofs.start))
        return [dof - self.dofs.start for dof in dofs if self.dofs.start <= dof < self.dofs.stop]


class StackedBasis(nn.Module):
    """A basis for each of D DoFs and the projection of weights through them, y = h(phi, w).

    The weights of a state are those of the first DoF, then of the second, and so on. Equal bases are
    evaluated once, and neighbouring DoFs that share one are projected together.

    Args:
        bases: D of them; two with the same class and settings are equal.

    Raises:
        ValueError: no basis; some periodic and others not.
    """

    def __init__(self, bases: Sequence[Basis]) -> None:
        super().__init__()
        if not bases:
            raise ValueError("StackedBasis needs a basis for at least one DoF")
        for basis in bases:
            if not isinstance(basis, Basis):
                raise ValueError(f"StackedBasis needs bases, one for each DoF, got {basis!r}")
        if len({basis.periodic for basis in bases}) > 1:
            raise ValueError("phases are those of a circle for all DoFs or for none: some bases are periodic")
        unique = list(dict.fromkeys(bases))
        self.unique = nn.ModuleList(unique)
        self._basis_of_dof = tuple(unique.index(basis) for basis in bases)
        counts = [basis.n_features for basis in bases]
        starts = [sum(counts[:i]) for i in range(len(counts) + 1)]
        self._weight_slices = tuple(slice(a, b) for a, b in pairwise(starts))
        self._runs = tuple(self._find_runs())

    @property
    def bases(self) -> tuple[Basis, ...]:
        """The basis of each DoF, D of them."""
        unique = self.families
        return tuple(unique[i] for i in self._basis_of_dof)

    @property
    def periodic(self) -> bool:
        """Whether phases are those of a circle."""
        return self.families[0].periodic

    @property
    def families(self) -> list[Basis]:
        """Each different basis once."""
        return list(self.unique)  # type: ignore[arg-type]

    @property
    def n_dofs(self) -> int:
        """D."""
        return len(self._basis_of_dof)

    @property
    def n_weights(self) -> int:
        """How many weights all DoFs have together (the paper's B)."""
        return self._weight_slices[-1].stop

    @property
    def weight_slices(self) -> tuple[slice, ...]:
        """Where each DoF's weights are, D of them."""
        return self._weight_slices

    def dof_of_weight(self) -> Tensor:
        """int64 [n_weights]: which DoF a weight belongs to."""
        counts = torch.tensor([part.stop - part.start for part in self._weight_slices], device="cpu")
        return torch.repeat_interleave(torch.arange(self.n_dofs, device="cpu"), counts)

    def select(self, dofs: Tensor) -> StackedBasis:
        """The stack of some DoFs only: bool [D], at least one True."""
        dofs = as_mask("dofs", dofs, self.n_dofs)
        return StackedBasis([basis for basis, chosen in zip(self.bases, dofs.tolist(), strict=True) if chosen])

    @without_autocast
    def project(
        self, phase: Tensor, weights: Tensor, dofs: Sequence[int] | None = None, centre: Tensor | None = None
    ) -> Tensor:
        """h(phi, w), a phase for each set of weights.

        Args:
            phase: [...].
            weights: [..., n_weights], of a shape that broadcasts with the phases.
            dofs: ascending indices of the k DoFs that are wanted; default: all D.
            centre: [..., n_weights], to be added to E sets of weights [..., E, n_weights]; default: nothing.

        Returns:
            [..., k], units of the DoFs.
        """
        features = [basis(phase) for basis in self.families]
        projections = self._project(features, weights, dofs)
        return projections if centre is None else projections + self._paths(features, centre, dofs)

    @without_autocast
    def project_apart(self, phase: Tensor, weights: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
        """h(phi, w) of E sets of weights at P phases each, and of their centre at those and at others.

        Args:
            phase: [..., P, E + others]: those of the sets first.
            weights: [..., E, n_weights], of which the ``centre`` was taken off.
            centre: [..., n_weights].

        Returns:
            [..., P, E, D] and [..., P, E + others, D], units of the DoFs: h of a whole set is their sum.
        """
        inside = bool(((phase >= 0) & (phase <= 1)).all())
        features = [basis.within(phase) if inside else basis(phase) for basis in self.families]
        E = weights.shape[-2]
        by_member = [each[..., :E, :].movedim(-3, -1) for each in features]  # one product a member, of all its phases
        parts = [
            (_select(block, run, run.wanted(None)) @ by_member[run.basis]).movedim(-1, -3)
            for run, block in zip(self._runs, self._blocks(weights), strict=True)
        ]
        own = torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]
        return own, self._paths(features, centre.unsqueeze(-2), None)

    @without_autocast
    def project_derivative(self, phase: Tensor, weights: Tensor) -> Tensor:
        """dh/dphi, shapes as `project`: the first column of the paper's Jacobian (equation of H_t)."""
        return self._project([basis.derivative(phase) for basis in self.families], weights, None)

    @without_autocast
    def project_rows(self, phase: Tensor, matrix: Tensor) -> Tensor:
        """h(phi, row) of every row of a matrix: with a covariance of the weights, the product with dh/dw'.

        Costs one multiplication an entry of the matrix, because each DoF sees only its own weights.

        Args:
            phase: [...].
            matrix: [..., m, n_weights].

        Returns:
            [..., m, D].
        """
        features = [basis(phase) for basis in self.families]
        parts = []
        for run, block in zip(self._runs, self._blocks(matrix), strict=True):
            shape = (*block.shape[:-1], run.dofs.stop - run.dofs.start)
            flat = block.reshape(*block.shape[:-2], -1, features[run.basis].shape[-1])
            parts.append((flat @ features[run.basis].unsqueeze(-1)).reshape(shape))
        return torch.cat(parts, dim=-1)

    @without_autocast
    def project_paths(self, phase: Tensor, weights: Tensor, dofs: Sequence[int] | None = None) -> Tensor:
        """h(phi, w) of each set of weights at several phases.

        Args:
            phase: [..., P].
            weights: [..., n_weights].
            dofs: ascending indices of the k DoFs that are wanted; default: all.

        Returns:
            [..., P, k].
        """
        return self._paths([basis(phase) for basis in self.families], weights, dofs)

    @without_autocast
    def project_covariance(self, phase: Tensor, covariance: Tensor) -> Tensor:
        """Variance of h(phi, w) for normal weights, Phi_d Sigma_dd Phi_d' for each DoF d.

        Args:
            phase: [..., P].
            covariance: Sigma of the weights, [..., n_weights, n_weights].

        Returns:
            [..., P, D], squared units of the DoFs.
        """
        blocks = []
        for run in self._runs:
            count = run.dofs.stop - run.dofs.start
            block = covariance[..., run.weights, run.weights]
            split = (count, block.shape[-1] // count)
            block = block.reshape(*block.shape[:-2], *split, *split)
            blocks.append(block.diagonal(dim1=-4, dim2=-2).movedim(-1, -3))
        return self.project_variances(phase, blocks)

    def variances(self, weights: Tensor) -> list[Tensor]:
        """Covariances of the weights of each DoF among themselves, over N sets of weights [N, n_weights].

        Returns:
            [k, B, B] for each run of k neighbouring DoFs with equal bases, for `project_variances`.
        """
        centred = weights - weights.mean(0)
        blocks = []
        for run, block in zip(self._runs, self._blocks(centred), strict=True):
            own = block.reshape(len(weights), run.dofs.stop - run.dofs.start, -1)
            blocks.append(torch.einsum("nkb,nkc->kbc", own, own) / (len(weights) - 1))
        return blocks

    @without_autocast
    def project_moments(self, phase: Tensor, mean: Tensor, blocks: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Mean and variance of h(phi, w), [..., P, D] each, units of the DoFs and squared.

        Args:
            phase: [..., P].
            mean: of the weights, [n_weights].
            blocks: [k, B, B] for each run, as `variances` gives them.
        """
        features = [basis(phase) for basis in self.families]
        return self._paths(features, mean, None), self._variances(features, blocks)

    @without_autocast
    def project_variances(self, phase: Tensor, blocks: Sequence[Tensor]) -> Tensor:
        """Variance of h(phi, w), [..., P, D], squared units of the DoFs.

        Args:
            phase: [..., P].
            blocks: [k, B, B] for each run, as `variances` gives them.
        """
        return self._variances([basis(phase) for basis in self.families], blocks)

    def _variances(self, features: Sequence[Tensor], blocks: Sequence[Tensor]) -> Tensor:
        parts = []
        for run, block in zip(self._runs, blocks, strict=True):
            functions = features[run.basis]
            towards = functions.unsqueeze(-3) @ block  # [..., k, P, B]
            parts.append((towards * functions.unsqueeze(-3)).sum(-1).transpose(-1, -2))
        return torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]

    def _paths(self, features: Sequence[Tensor], weights: Tensor, dofs: Sequence[int] | None) -> Tensor:
        parts = []
        for run, block in zip(self._runs, self._blocks(weights), strict=True):
            wanted = run.wanted(dofs)
            if wanted:
                block = _select(block, run, wanted)
                parts.append(features[run.basis] @ block.transpose(-1, -2))
        return torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]

    def _project(self, features: Sequence[Tensor], weights: Tensor, dofs: Sequence[int] | None) -> Tensor:
        parts = []
        for run, block in zip(self._runs, self._blocks(weights), strict=True):
            wanted = run.wanted(dofs)
            if wanted:
                block = _select(block, run, wanted)
                parts.append((block @ features[run.basis].unsqueeze(-1)).squeeze(-1))
        return torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0]

    def _blocks(self, weights: Tensor) -> Sequence[Tensor]:
        """The weights of each run, [..., k]: by one split, whose backward pass is one concatenation."""
        if weights.shape[-1] != self.n_weights:
            raise ValueError(f"weights must end in {self.n_weights}, got {tuple(weights.shape)}")
        return torch.split(weights, [run.weights.stop - run.weights.start for run in self._runs], dim=-1)

    def _find_runs(self) -> list[_Run]:
        runs: list[_Run] = []
        for dof, basis in enumerate(self._basis_of_dof):
            weights = self._weight_slices[dof]
            if runs and runs[-1].basis == basis:
                last = runs.pop()
                runs.append(_Run(basis, slice(last.dofs.start, dof + 1), slice(last.weights.start, weights.stop)))
            else:
                runs.append(_Run(basis, slice(dof, dof + 1), weights))
        return runs

    def extra_repr(self) -> str:
        """Sizes, and for how many neighbouring DoFs each basis serves."""
        runs = ", ".join(f"{run.dofs.stop - run.dofs.start} x ({run.basis})" for run in self._runs)
        return f"n_dofs={self.n_dofs}, n_weights={self.n_weights}, bases={runs}"


def _select(block: Tensor, run: _Run, wanted: list[int]) -> Tensor:
    """Weights [..., k, B] of some DoFs of a run, whose are [..., n_weights of the run]: a view for neighbours."""
    count = run.dofs.stop - run.dofs.start
    block = block.reshape(*block.shape[:-1], count, block.shape[-1] // count)
    first, count = wanted[0], len(wanted)
    if wanted == list(range(first, first + count)):
        return block.narrow(-2, first, count)
    return block[..., wanted, :]
