"""What tuning minimises: scores of forecasts made at many horizons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned, without_autocast
from torch_ebip.common.arguments import as_mask, as_number, as_values
from torch_ebip.common.meaning import Meaning
from torch_ebip.filtering.trace import Trace
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.kinematics import RobotArm
from torch_ebip.learning.losses import ForwardKinematicsLoss, InnovationLikelihoodLoss, TrajectoryLoss
from torch_ebip.recordings.layout import Layout


class Weights(NamedTuple):
    """How much each term of the objective counts; a term of weight 0 is not computed.

    Attributes:
        crps: CRPS of the forecast, DoFs in units of their spread over the demonstrations:
            accuracy and calibration.
        squared_error: of the ensemble mean, in the same units squared.
        tool: distance of the arm's tool in metres (needs an arm).
        innovation: one-step negative log-likelihood of the measurements, nats a value.
    """

    crps: float = 1.0
    squared_error: float = 1.0
    tool: float = 0.0
    innovation: float = 0.0


class ForecastObjective(Meaning):
    """Scores the forecasts that a filter makes of some DoFs, from states kept at several horizons.

    The target is an interaction's own regression, so it exists at every phase. Each DoF counts in units of its
    standard deviation at phase 1 over the demonstrations.

    Args:
        primitive: of the demonstrations that are tuned on.
        targets: bool [D], the DoFs to forecast.
        phases: [P], where between now (0) and the end (1) the forecast is scored.
        weights: of the terms.
        arm: for the term ``tool``: a loss on its joints.
        arm_dofs: bool [D], the joints of the arm, all of them targets. Where they have the names of the arm's joints
            they are taken by name, in whatever order the columns are; otherwise in order.

    Raises:
        ValueError: no target, a target that never varies, a negative weight, or a tool term without an arm; joints
            that are no targets, are not as many as the arm's, have some of their names only, or another unit.
    """

    phases: Tensor
    scale: Tensor

    def __init__(
        self,
        primitive: InteractionPrimitive,
        targets: Tensor,
        phases: Tensor | None = None,
        weights: Weights | None = None,
        arm: ForwardKinematicsLoss | None = None,
        arm_dofs: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.weights = Weights() if weights is None else weights
        for term, weight in self.weights._asdict().items():
            as_number(f"the weight of {term}", weight, 0)
        targets = as_mask("targets", targets, primitive.layout.n_dofs).to(primitive.weights.device)
        if self.weights.tool and (arm is None or arm_dofs is None):
            raise ValueError("the tool term needs an arm and the DoFs that are its joints")
        ends = primitive.end_variance
        fixed = targets & ~(ends > 1e-8 * primitive.residual_variance)
        if not bool(targets.any()) or bool(fixed.any()):
            names = [dof for dof, still in zip(primitive.layout.dofs, fixed.tolist(), strict=True) if still]
            raise ValueError(f"targets must be DoFs that end differently in different demonstrations, got {names}")
        scale = ends.sqrt()[targets]
        self.register_buffer("scale", owned(scale))
        self.squared_error = TrajectoryLoss(scale)
        self.innovation = InnovationLikelihoodLoss()
        self.arm = arm
        self.names = [dof for dof, ours in zip(primitive.layout.dofs, targets.tolist(), strict=True) if ours]
        self.joints = None
        if arm is not None and arm_dofs is not None:
            self.joints = _joints(arm.arm, primitive.layout, as_mask("arm_dofs", arm_dofs, len(targets)), self.names)
        phases = scale.new_tensor([0.5, 1.0]) if phases is None else as_values("phases", phases, None, scale)
        if phases.ndim != 1 or not bool(((phases >= 0) & (phases <= 1)).all()):
            raise ValueError(f"phases must be [P], from 0 (now) to 1 (the end), got {phases}")
        self.register_buffer("phases", owned(phases))

    def extra_repr(self) -> str:
        """What is scored, and how much each term counts."""
        return f"targets={', '.join(self.names)}, {self.weights}"

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        return f"targets={', '.join(self.names)}"

    @without_autocast
    def forward(
        self, filter: InteractionFilter, trace: Trace, observed: Tensor, truth: Tensor, now: Tensor, targets: Tensor
    ) -> dict[str, Tensor]:
        """Weighted terms by name; their sum is the loss.

        Args:
            filter: that made the trace.
            trace: with states kept at K horizons, batch [B].
            observed: bool [B, T, D'], what the filter was shown (D' DoFs of the filter).
            truth: [B, K, P, D_targets], at `phases_ahead`.
            now: [B, K], true phases of the horizons.
            targets: bool [D'], the targets among the filter's DoFs.

        Raises:
            ValueError: the trace kept no states.
        """
        if trace.kept is None:
            raise ValueError("the trace kept no states to forecast from")
        forecast = filter.forecast(trace.kept, self.phases_ahead(now)).select(targets)
        terms = {}
        if self.weights.crps:
            terms["crps"] = self.weights.crps * (forecast.crps(truth) / self.scale).mean()
        if self.weights.squared_error:
            terms["squared_error"] = self.weights.squared_error * self.squared_error(forecast.mean, truth)
        if self.weights.tool and self.arm is not None and self.joints is not None:
            joints, wanted = forecast.mean[..., -1, self.joints], truth[..., -1, self.joints]
            terms["tool"] = self.weights.tool * self.arm(joints, wanted)
        if self.weights.innovation:
            terms["innovation"] = self.weights.innovation * self.innovation(trace.log_likelihood, observed)
        return terms

    def phases_ahead(self, now: Tensor) -> Tensor:
        """Phases [..., P] that are scored from the phases now [...] of the horizons."""
        return now.unsqueeze(-1) + (1 - now.unsqueeze(-1)) * self.phases

    @without_autocast
    def spread_and_error(self, filter: InteractionFilter, trace: Trace, truth: Tensor, targets: Tensor) -> Tensor:
        """[2]: root mean variance of the forecasts of phase 1 and root mean squared error of their mean.

        Both in units of the targets' spread over the demonstrations; equal for a calibrated filter.

        Args:
            filter: that made the trace.
            trace: with states kept at K horizons, batch [B].
            truth: [B, K, P, D_targets], the last of the P phases being 1.
            targets: bool [D'], the targets among the filter's DoFs.

        Raises:
            ValueError: the trace kept no states.
        """
        if trace.kept is None:
            raise ValueError("the trace kept no states to forecast from")
        end = torch.ones(1, dtype=truth.dtype, device=truth.device)
        forecast = filter.forecast(trace.kept, end).select(targets)
        error = (forecast.mean[..., 0, :] - truth[..., -1, :]) / self.scale
        variance = forecast.variance / self.scale.square()
        return torch.stack([variance.mean().sqrt(), error.square().mean().sqrt()])


def joints_of(arm: RobotArm, layout: Layout, targets: Sequence[str]) -> list[str]:
    """The target modality that holds an arm's joints: by their names, or because only it has as many DoFs.

    Args:
        arm: whose joints they are.
        layout: of the recordings.
        targets: names of modalities.

    Raises:
        ValueError: none does, or several.
    """
    named = [name for name in targets if set(layout[name].dofs) & set(arm.joint_names)]
    alike = named or [name for name in targets if len(layout[name].dofs) == arm.n_joints]
    if len(alike) != 1:
        raise ValueError(
            f"no target is the arm's {arm.n_joints} joints ({', '.join(arm.joint_names)}): "
            f"{', '.join(f'{name} has {len(layout[name].dofs)} DoFs' for name in targets)}; say which with `joints`"
        )
    return alike


def _joints(arm: RobotArm, layout: Layout, dofs: Tensor, targets: list[str]) -> list[int]:
    """Which of the targets is each of an arm's joints, in the arm's order; see `ForecastObjective`."""
    names = [dof for dof, ours in zip(layout.dofs, dofs.tolist(), strict=True) if ours]
    strangers = [name for name in names if name not in targets]
    if strangers:
        raise ValueError(f"the arm's joints must be targets, which {', '.join(strangers)} are not")
    if len(names) != arm.n_joints:
        raise ValueError(f"the arm has {arm.n_joints} joints ({', '.join(arm.joint_names)}), got {', '.join(names)}")
    if set(names) & set(arm.joint_names):
        unknown = [name for name in names if name not in arm.joint_names]
        if unknown:
            raise ValueError(
                f"some DoFs are named after the arm's joints ({', '.join(arm.joint_names)}), "
                f"{', '.join(unknown)} are not"
            )
        names = list(arm.joint_names)
    for joint, name, unit in zip(arm.joint_names, names, arm.joint_units, strict=True):
        theirs = layout.units[layout.dofs.index(name)]
        if theirs != unit:
            raise ValueError(f"the arm's joint {joint!r} is in {unit!r}, but {name!r} of the layout in {theirs!r}")
    return [targets.index(name) for name in names]
