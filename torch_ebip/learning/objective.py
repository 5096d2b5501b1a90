"""What tuning minimises: scores of forecasts made at many horizons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned, without_autocast
from torch_ebip.common.arguments import as_mask, as_number, as_values
from torch_ebip.common.meaning import Meaning
from torch_ebip.filtering.states import State
from torch_ebip.filtering.trace import Trace
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.kinematics import RobotArm
from torch_ebip.learning.horizons import LEAST, LEAST_END, as_ahead, goes_on, horizon_name, spread_ahead
from torch_ebip.learning.losses import ForwardKinematicsLoss, InnovationLikelihoodLoss
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

    Either at phases between now and the end, against an interaction's own regression, which exists at every phase;
    or so many seconds ahead, against what was recorded then, every horizon counting alike. Each DoF counts in units
    of its standard deviation over the demonstrations: at phase 1; for seconds, at the times since they began that the
    horizon asks for, and at the end at least a tenth of that, since interactions may all end alike.

    Args:
        primitive: of the demonstrations that are tuned on.
        targets: bool [D], the DoFs to forecast.
        phases: [P], where between now (0) and the end (1) the forecast is scored; default: half-way and the end.
        weights: of the terms.
        arm: for the term ``tool``: a loss on its joints.
        arm_dofs: bool [D], the joints of the arm, all of them targets. Where they have the names of the arm's joints
            they are taken by name, in whatever order the columns are; otherwise in order.
        ahead: [P] instead of phases, seconds from now at which it is scored, increasing; infinity, which comes last,
            is the end.

    Raises:
        ValueError: no target, a target that never varies, a negative weight, or a tool term without an arm; joints
            that are no targets, are not as many as the arm's, have some of their names only, or another unit; phases
            and seconds; seconds that are not increasing, or longer than nearly all demonstrations go on.
    """

    phases: Tensor
    ahead: Tensor | None
    scale: Tensor
    shares: Tensor | None

    def __init__(
        self,
        primitive: InteractionPrimitive,
        targets: Tensor,
        phases: Tensor | None = None,
        weights: Weights | None = None,
        arm: ForwardKinematicsLoss | None = None,
        arm_dofs: Tensor | None = None,
        ahead: Sequence[float] | Tensor | None = None,
    ) -> None:
        super().__init__()
        if ahead is not None and phases is not None:
            raise ValueError("forecasts are scored at phases or at seconds ahead, got both")
        self.weights = Weights() if weights is None else weights
        for term, weight in self.weights._asdict().items():
            as_number(f"the weight of {term}", weight, 0)
        targets = as_mask("targets", targets, primitive.layout.n_dofs).to(primitive.weights.device)
        if self.weights.tool and (arm is None or arm_dofs is None):
            raise ValueError("the tool term needs an arm and the DoFs that are its joints")
        ends = primitive.end_variance
        seconds = None if ahead is None else as_ahead(ahead, ends)
        spreads = ends.unsqueeze(0) if seconds is None else spread_ahead(primitive, seconds)
        often = spreads.amax(0)
        fixed = targets & ~((often > 1e-8 * primitive.residual_variance) & (primitive.value_variance > 0))
        if not bool(targets.any()) or bool(fixed.any()):
            names = [dof for dof, still in zip(primitive.layout.dofs, fixed.tolist(), strict=True) if still]
            how = "end differently" if ahead is None else "differ"
            raise ValueError(f"targets must be DoFs that {how} in different demonstrations, got {names}")
        scale = ends.sqrt()[targets]
        shares = None
        if seconds is not None:
            shares = goes_on(primitive, seconds)
            if bool((shares < LEAST).any()):
                early = ", ".join(f"{float(a):g} s" for a in seconds[shares < LEAST])
                raise ValueError(f"{early} ahead lies behind the end of nearly all demonstrations: leave it out")
            scale = torch.maximum(spreads, LEAST_END**2 * often)[:, targets].sqrt()
        self.register_buffer("ahead", None if seconds is None else owned(seconds))
        self.register_buffer("shares", None if shares is None else owned(shares))
        self.register_buffer("scale", owned(scale))
        self.innovation = InnovationLikelihoodLoss()
        self.arm = arm
        self.names = [dof for dof, ours in zip(primitive.layout.dofs, targets.tolist(), strict=True) if ours]
        self.joints = None
        if arm is not None and arm_dofs is not None:
            self.joints = _joints(arm.arm, primitive.layout, as_mask("arm_dofs", arm_dofs, len(targets)), self.names)
        phases = scale.new_tensor([0.5, 1.0]) if phases is None else as_values("phases", phases, None, ends)
        if phases.ndim != 1 or not bool(((phases >= 0) & (phases <= 1)).all()):
            raise ValueError(f"phases must be [P], from 0 (now) to 1 (the end), got {phases}")
        self.register_buffer("phases", owned(phases))

    def extra_repr(self) -> str:
        """What is scored, and how much each term counts."""
        ahead = "" if self.ahead is None else f", ahead={self.ahead.tolist()}"
        return f"targets={', '.join(self.names)}, {self.weights}{ahead}"

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        return f"targets={', '.join(self.names)}"

    @property
    def horizons(self) -> tuple[str, ...] | None:
        """Names of the P horizons, such as ``0.25 s`` and ``end``; None for phases."""
        return None if self.ahead is None else tuple(horizon_name(a) for a in self.ahead.tolist())

    @without_autocast
    def forward(
        self, filter: InteractionFilter, trace: Trace, observed: Tensor, truth: Tensor, now: Tensor, targets: Tensor
    ) -> dict[str, Tensor]:
        """Weighted terms by name; their sum is the loss.

        Args:
            filter: that made the trace.
            trace: with states kept at K horizons, batch [B].
            observed: bool [B, T, D'], what the filter was shown (D' DoFs of the filter).
            truth: [B, K, P, D_targets], at `phases_ahead`, or ``ahead`` seconds later; NaN: not measured.
            now: [B, K], true phases of the horizons.
            targets: bool [D'], the targets among the filter's DoFs.

        Raises:
            ValueError: the trace kept no states.
        """
        if trace.kept is None:
            raise ValueError("the trace kept no states to forecast from")
        forecast = self.forecast(filter, trace.kept, now).select(targets)
        measured = ~truth.isnan()
        # Before the arithmetic: a NaN that is multiplied by 0 afterwards is NaN, and so is its gradient.
        wanted = torch.where(measured, truth, forecast.mean.detach())
        terms = {}
        if self.weights.crps:
            terms["crps"] = self.weights.crps * self.mean(forecast.crps(wanted) / self.scale, measured)
        if self.weights.squared_error:
            squares = ((forecast.mean - wanted) / self.scale).square()
            terms["squared_error"] = self.weights.squared_error * self.mean(squares, measured)
        if self.weights.tool and self.arm is not None and self.joints is not None:
            joints, wanted = forecast.mean[..., -1, self.joints], truth[..., -1, self.joints]
            terms["tool"] = self.weights.tool * self.arm(joints, wanted)
        if self.weights.innovation:
            terms["innovation"] = self.weights.innovation * self.innovation(trace.log_likelihood, observed)
        return terms

    def forecast(self, filter: InteractionFilter, state: State, now: Tensor) -> Forecast:
        """What a filter says at the horizons that are scored.

        Args:
            filter: of the state.
            state: batch [B, K].
            now: [B, K], true phases.
        """
        if self.ahead is None:
            return filter.forecast(state, self.phases_ahead(now))
        return filter.forecast(state, ahead=self.ahead)

    def mean(self, values: Tensor, measured: Tensor) -> Tensor:
        """Scalar, of values [B, K, P, D_targets] where measured; of seconds, every horizon counts alike.

        What is divided by does not depend on the batch, so that parts of it have a mean.
        """
        if self.ahead is None or self.shares is None:
            return torch.where(measured, values, 0).mean()
        return (torch.where(measured, values, 0).mean((0, 1, 3)) / self.shares).mean()

    def phases_ahead(self, now: Tensor) -> Tensor:
        """Phases [..., P] that are scored from the phases now [...] of the horizons."""
        return now.unsqueeze(-1) + (1 - now.unsqueeze(-1)) * self.phases

    @without_autocast
    def spread_and_error(self, filter: InteractionFilter, trace: Trace, truth: Tensor, targets: Tensor) -> Tensor:
        """[2]: root mean variance of the forecasts of phase 1 and root mean squared error of their mean; on a circle,
        which has no end, of the last horizon.

        Both in units of the targets' spread over the demonstrations; equal for a calibrated filter.

        Args:
            filter: that made the trace.
            trace: with states kept at K horizons, batch [B].
            truth: [B, K, P, D_targets], the last of the P horizons being the end.
            targets: bool [D'], the targets among the filter's DoFs.

        Raises:
            ValueError: the trace kept no states.
        """
        if trace.kept is None:
            raise ValueError("the trace kept no states to forecast from")
        end = torch.ones(1, dtype=truth.dtype, device=truth.device)
        if filter.phase_model.periodic and self.ahead is not None:  # nobody knows the phase of an end
            forecast = filter.forecast(trace.kept, ahead=self.ahead[-1:]).select(targets)
        else:
            forecast = filter.forecast(trace.kept, end).select(targets)
        scale = self.scale if self.ahead is None else self.scale[-1]
        error = (forecast.mean[..., 0, :] - truth[..., -1, :]) / scale
        error = torch.where(error.isnan(), 0, error)
        variance = forecast.variance / scale.square()
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


def objective_for(
    primitive: InteractionPrimitive,
    targets: Tensor,
    names: Sequence[str],
    ahead: Sequence[float],
    arm: RobotArm | ForwardKinematicsLoss | None,
    joints: str | None,
) -> ForecastObjective:
    """What `learn` minimises.

    Args:
        primitive: of the demonstrations.
        targets: bool [D], the DoFs of the modalities with these ``names``.
        names: of the targets.
        ahead: horizons, s.
        arm, joints: see `learn`.
    """
    if arm is None:
        return ForecastObjective(primitive, targets, ahead=ahead)
    loss = arm if isinstance(arm, ForwardKinematicsLoss) else ForwardKinematicsLoss(arm, rotation_weight=0.1)
    layout = primitive.layout
    dofs = layout.mask(joints_of(loss.arm, layout, names) if joints is None else [joints])
    return ForecastObjective(
        primitive, targets, weights=Weights(tool=1.0), arm=loss, arm_dofs=dofs.to(targets.device), ahead=ahead
    )
