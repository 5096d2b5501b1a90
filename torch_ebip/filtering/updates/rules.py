"""Rules: how an innovation moves the members. Each is written once, over `torch_ebip.functional`.

Beside the plain form, which is differentiable and takes any R, each has a twin for the live path: R diagonal, members
as columns, results into buffers. Tests hold the two equal.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.common.modules import FastTwins
from torch_ebip.filtering import functional
from torch_ebip.filtering.functional import Innovation
from torch_ebip.filtering.updates.part import Part


class Columns(NamedTuple):
    """An innovation of K DoFs with members as columns and in the units of the DoFs, and buffers for a solution.

    Attributes:
        anomalies: HA, [..., K, E].
        residual: y - mean HX, [..., K, 1]: the last column of ``right``.
        deviation: square root of R, [..., K, 1].
        factor: lower Cholesky factor of S, [..., K, K].
        right, solved: right-hand sides and solutions, [..., K, E + 1], columns contiguous for LAPACK: of the members,
            and in the last column of the mean.
        right_members, moves, shift: views of them: [..., K, E] of either, and the last column of the solutions.
    """

    anomalies: Tensor
    residual: Tensor
    deviation: Tensor
    factor: Tensor
    right: Tensor
    solved: Tensor
    right_members: Tensor
    moves: Tensor
    shift: Tensor

    def __repr__(self) -> str:
        return brief(self)


class Rule(FastTwins, Part, ABC):
    """How an innovation moves the members."""

    twins: ClassVar[dict[str, tuple[str, ...]]] = {"forward": ("columns",)}
    perturbs = False
    """Whether it needs draws, one for each member and DoF."""

    def meant(self) -> None:
        """No part of what tensors mean, see `Meaning`: how a filter runs."""

    @abstractmethod
    def forward(self, innovation: Innovation, perturbations: Tensor | None) -> Tensor:
        """Moves [..., E, D]: what of each member went through S^-1, for `functional.apply_gain`.

        Args:
            innovation: of what was measured.
            perturbations: standard-normal draws [..., E, D] of a rule that perturbs; None of another.
        """

    @abstractmethod
    def columns(self, columns: Columns, perturbations: Tensor | None) -> tuple[Tensor, Tensor]:
        """The same for the live path.

        Args:
            columns: the innovation; its buffers are overwritten.
            perturbations: standard-normal draws [..., K, E].

        Returns:
            Moves [..., K, E], and the move of the mean, S^-1 (y - mean HX), [..., K, 1].
        """


class Stochastic(Rule):
    """The paper's: every member is compared with a perturbed observation, y + eps - h(x)."""

    perturbs = True

    def forward(self, innovation: Innovation, perturbations: Tensor | None) -> Tensor:
        """See `Rule.forward`: innovation, perturbations [..., E, D] -> moves [..., E, D]."""
        assert perturbations is not None
        return functional.stochastic_moves(innovation, perturbations)

    def columns(self, columns: Columns, perturbations: Tensor | None) -> tuple[Tensor, Tensor]:
        """See `Rule.columns`: columns, perturbations [..., K, E] -> moves [..., K, E] and [..., K, 1]."""
        assert perturbations is not None
        # y + eps - HX, as (y - mean) + eps - HA: what is not measured is 0 in all of them.
        right = torch.addcmul(columns.residual, columns.deviation, perturbations, out=columns.right_members)
        right.sub_(columns.anomalies)
        torch.cholesky_solve(columns.right, columns.factor, out=columns.solved)
        return columns.moves, columns.shift


class SquareRoot(Rule):
    """Deterministic: the anomalies get the Kalman posterior of their own covariance; see `square_root_moves`."""

    def forward(self, innovation: Innovation, perturbations: Tensor | None) -> Tensor:
        """See `Rule.forward`: innovation, no perturbations -> moves [..., E, D]."""
        return functional.square_root_moves(innovation)

    def columns(self, columns: Columns, perturbations: Tensor | None) -> tuple[Tensor, Tensor]:
        """See `Rule.columns`: columns, no perturbations -> moves [..., K, E] and [..., K, 1]."""
        V, U = columns.factor, torch.diag_embed(columns.deviation[..., 0])
        shift = torch.cholesky_solve(columns.residual, V)
        shrink = torch.linalg.solve_triangular(V + U, columns.anomalies, upper=False)
        return shift - torch.linalg.solve_triangular(V.transpose(-1, -2), shrink, upper=True), shift
