"""Losses as modules. Targets that were not measured (NaN) are left out before the arithmetic."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned, without_autocast
from torch_ebip.filtering.functional.scores import crps, energy_score
from torch_ebip.kinematics import RobotArm


class TrajectoryLoss(nn.Module):
    """Mean squared error of forecasts, in units of each DoF's scale.

    Args:
        scale: [D], what counts as one unit of error of each DoF, for example its standard deviation over the
            demonstrations; in units of the DoFs.
        dofs: bool [D], which DoFs count; default: all.

    Raises:
        ValueError: a scale that is not positive, or no DoF.
    """

    scale: Tensor
    dofs: Tensor

    def __init__(self, scale: Tensor, dofs: Tensor | None = None) -> None:
        super().__init__()
        dofs = torch.ones_like(scale, dtype=torch.bool) if dofs is None else dofs
        if scale.shape != dofs.shape or not bool((scale[dofs] > 0).all()) or not bool(dofs.any()):
            raise ValueError("scale must be [D] and positive for the chosen DoFs, of which there must be one")
        self.register_buffer("scale", owned(scale))
        self.register_buffer("dofs", owned(dofs))

    def forward(self, predicted: Tensor, target: Tensor) -> Tensor:
        """From predicted and target [..., D] (phases and batches in front), units of the DoFs: unitless scalar."""
        error, measured = self._errors(predicted, target)
        return error.square().mul(measured).sum() / measured.sum().clamp(min=1)

    def _errors(self, predicted: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Predicted less target in units of the scale, and which targets were measured."""
        target = target[..., self.dofs]
        measured = ~target.isnan()
        return (predicted[..., self.dofs] - torch.where(measured, target, 0)) / self.scale[self.dofs], measured


class CRPSLoss(TrajectoryLoss):
    """Mean fair CRPS of an ensemble forecast in units of each DoF's scale; arguments as `TrajectoryLoss`."""

    def forward(self, predicted: Tensor, target: Tensor, weights: Tensor | None = None) -> Tensor:
        """Mean over all that was measured.

        Args:
            predicted: members [..., E, D], units of the DoFs.
            target: [..., D], units of the DoFs; NaN where not measured.
            weights: of the members, [..., E], summing to 1; default: equal.

        Returns:
            scalar, without unit.
        """
        errors, measured = self._errors(predicted, target.unsqueeze(-2))
        measured = measured.squeeze(-2)
        scores = crps(errors, torch.zeros_like(errors[..., 0, :]), weights)
        return scores.mul(measured).sum() / measured.sum().clamp(min=1)


class EnergyScoreLoss(TrajectoryLoss):
    """Mean fair energy score of an ensemble forecast, DoFs scaled; arguments as `TrajectoryLoss`.

    A DoF that was not measured counts as forecast exactly: it is left out of the distances.
    """

    def forward(self, predicted: Tensor, target: Tensor) -> Tensor:
        """From predicted members [..., E, D] and target [..., D], units of the DoFs: scalar, without unit."""
        errors, measured = self._errors(predicted, target.unsqueeze(-2))
        errors = torch.where(measured, errors, 0)
        return energy_score(errors, torch.zeros_like(errors[..., 0, :])).mean()


class InnovationLikelihoodLoss(nn.Module):
    """Mean negative log-likelihood of each measured value given the past, from `Trace.log_likelihood`.

    A one-step score: it prefers a small R and says little about forecasts of the end; use it beside others.
    """

    def forward(self, log_likelihood: Tensor, observed: Tensor) -> Tensor:
        """From log_likelihood [..., T] and observed, bool [..., T, D]: scalar, nats a measured value."""
        return -log_likelihood.sum() / observed.sum().clamp(min=1)


class ForwardKinematicsLoss(nn.Module):
    """Mean distance of the tool from where it should be, through the arm's forward kinematics.

    Args:
        arm: joints -> pose.
        rotation_weight: metres that one radian of geodesic angle between the two orientations counts for.
    """

    def __init__(self, arm: RobotArm, rotation_weight: float = 0.0) -> None:
        super().__init__()
        if not rotation_weight >= 0:
            raise ValueError(f"rotation_weight must not be negative, got {rotation_weight}")
        self.arm = arm
        self.rotation_weight = rotation_weight

    def forward(self, predicted_joints: Tensor, target_joints: Tensor) -> Tensor:
        """Mean over all rows but those with NaN in the target.

        Args:
            predicted_joints: [..., n_joints], rad.
            target_joints: [..., n_joints], rad.

        Returns:
            scalar, metres.
        """
        measured = ~target_joints.isnan().any(-1)
        predicted = self.arm(predicted_joints)
        target = self.arm(torch.where(measured.unsqueeze(-1), target_joints, 0))
        distance = _norm(predicted[..., :3, 3] - target[..., :3, 3])
        if self.rotation_weight:
            distance = distance + self.rotation_weight * geodesic_angle(predicted[..., :3, :3], target[..., :3, :3])
        return distance.mul(measured).sum() / measured.sum().clamp(min=1)


@without_autocast
def geodesic_angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle in rad [...] of the rotation between rotation matrices a and b, [..., 3, 3]; gradient 0 at 0 and pi."""
    between = a.transpose(-1, -2) @ b
    cosine = (between.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    skew = between - between.transpose(-1, -2)
    sine = _norm(torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)) / 2
    return torch.atan2(sine, cosine)


def _norm(vector: Tensor) -> Tensor:
    """Euclidean norm with gradient 0 at 0."""
    squared = vector.square().sum(-1)
    positive = squared > 0
    return torch.where(positive, torch.where(positive, squared, 1).sqrt(), 0)
