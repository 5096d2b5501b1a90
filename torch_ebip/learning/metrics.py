"""What experiments report about a forecast, one value an interaction; NaN where the target was not measured."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.interaction.forecast import Forecast
from torch_ebip.kinematics import RobotArm

Z95 = 1.959963984540054
"""Half-width of the central 95 % interval of a normal distribution, in standard deviations."""


def mse(forecast: Forecast, target: Tensor) -> Tensor:
    """Squared error averaged over DoFs: forecast [..., D], target [..., D] -> [...], squared units."""
    return (forecast.mean - target).square().nanmean(-1)


def mae(forecast: Forecast, target: Tensor) -> Tensor:
    """Absolute error averaged over DoFs: forecast [..., D], target [..., D] -> [...], units of the DoFs."""
    return (forecast.mean - target).abs().nanmean(-1)


def coverage_95(forecast: Forecast, target: Tensor) -> Tensor:
    """Share of the DoFs whose target lies in mean +- 1.96 deviations; 0.95 would be right.

    Args:
        forecast: [..., D].
        target: [..., D], units of the DoFs.

    Returns:
        [...], without unit.
    """
    inside = (forecast.mean - target).abs() <= Z95 * forecast.variance.sqrt()
    unknown = target.isnan() | forecast.mean.isnan()
    return inside.to(target.dtype).where(~unknown, torch.nan).nanmean(-1)


def crps(forecast: Forecast, target: Tensor) -> Tensor:
    """CRPS averaged over DoFs: forecast [..., D], target [..., D] -> [...], units of the DoFs."""
    return forecast.crps(target).nanmean(-1)


def phase_error(phase: Tensor, true_phase: Tensor) -> Tensor:
    """Absolute error of the inferred phase: phase [...], true_phase [...] -> [...]."""
    return (phase - true_phase).abs()


def tool_error(arm: RobotArm, joints: Tensor, target_joints: Tensor) -> Tensor:
    """Distance of the tool from where it should be.

    Args:
        arm: whose tool it is.
        joints: [..., n_joints], rad.
        target_joints: [..., n_joints], rad.

    Returns:
        [...], metres.
    """
    distance: Tensor = (arm(joints)[..., :3, 3] - arm(target_joints)[..., :3, 3]).norm(dim=-1)
    return distance
